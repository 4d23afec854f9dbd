"""A grid of points in and round a box, in the box's own axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from regnf_core.geometry.box import OrientedBox

Mask = NDArray[np.bool_]


def signed_distance_to(mask: Mask, cell: float) -> NDArray[np.float64]:
    """To the edge of the cells of ``mask``, negative in them; where there are none, or only these, about as far as the
    grid is wide."""
    most = float(np.linalg.norm(mask.shape))
    outside = distance_transform_edt(~mask) if mask.any() else most
    inside = distance_transform_edt(mask) if not mask.all() else most
    signed = np.clip(outside, 0.0, most) - np.clip(inside, 0.0, most)
    found: NDArray[np.float64] = (signed - 0.5 * np.sign(signed)) * cell
    return found


def box_distance(box: OrientedBox, points: Tensor) -> Tensor:
    """(N,) exact signed distance of points (N, 3) to a solid box, negative inside."""
    beyond = box.to_local(points).abs() - box.size.to(points) / 2.0
    outside: Tensor = beyond.clamp_min(0.0).norm(dim=-1)
    return outside + beyond.amax(-1).clamp_max(0.0)


@dataclass(frozen=True, eq=False)
class RegionGrid:
    """Cells of edge ``cell`` along the axes of ``box``, which they cover. shape: (3,) how many along each."""

    box: OrientedBox
    cell: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, box: OrientedBox, along_longest: int) -> RegionGrid:
        cell = float(box.size.max()) / along_longest
        x, y, z = (max(1, int(n)) for n in (box.size / cell).ceil().tolist())
        return cls(box, cell, (x, y, z))

    def points(self) -> Tensor:
        """(X * Y * Z, 3) float32, the cells' middles, frame of the box."""
        axes = [(torch.arange(n, dtype=torch.float64) + 0.5 - n / 2.0) * self.cell for n in self.shape]
        return (self.box.center + torch.cartesian_prod(*axes) @ self.box.rotation.T).float()

    def cube(self, values: Tensor) -> NDArray[np.float32]:
        """Values (X * Y * Z,) of the cells as (X, Y, Z)."""
        cube: NDArray[np.float32] = values.float().cpu().numpy().reshape(self.shape)
        return cube

    def distance_to(self, mask: Mask) -> GridDistance:
        """The signed distance to the cells of ``mask`` (X, Y, Z), negative in them."""
        return GridDistance(self, torch.from_numpy(signed_distance_to(mask, self.cell).astype(np.float32)))


@dataclass(frozen=True, eq=False)
class GridDistance:
    """Values at a grid's middles, interpolated between them and constant beyond. values: (X, Y, Z) float32."""

    grid: RegionGrid
    values: Tensor

    def at(self, points: Tensor) -> Tensor:
        """(N,) at points (N, 3) of the frame of the grid's box."""
        return self._sampled(self._places(points))

    def at_with_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) and the gradient (N, 3), by differences of half a cell."""
        places, step = self._places(points), 0.5
        slopes = []
        for axis in range(3):
            move = torch.zeros(3, device=places.device)
            move[axis] = step
            slopes.append((self._sampled(places + move) - self._sampled(places - move)) / (2 * step * self.grid.cell))
        local = torch.stack(slopes, dim=-1)
        return self._sampled(places), local @ self.grid.box.rotation.to(local).T

    def _places(self, points: Tensor) -> Tensor:
        half = torch.tensor(self.grid.shape, device=points.device) / 2.0
        return self.grid.box.to_local(points) / self.grid.cell + half - 0.5

    def _sampled(self, places: Tensor) -> Tensor:
        values = self.values.to(places.device)
        most = torch.tensor(values.shape, device=places.device) - 1
        places = places.clamp_min(0.0).minimum(most.to(places))
        low = places.floor().long().minimum((most - 1).clamp_min(0))
        share = places - low
        total = torch.zeros(len(places), device=places.device)
        for corner in range(8):
            bit = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=places.device)
            index = (low + bit).minimum(most)
            weight = torch.where(bit == 1, share, 1.0 - share).prod(-1)
            x, y, z = index.unbind(-1)
            total = total + weight * values[x, y, z]
        return total

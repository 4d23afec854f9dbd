"""A grid of points in and round a box, in the box's own axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor

from regnf_core.fields.composite import TransformedField, near_origin
from regnf_core.fields.observation import Observation, SdfField, has_color, inverse_deviation_of, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.description import SURFACE

Mask = NDArray[np.bool_]


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
        outside = distance_transform_edt(~mask) if mask.any() else np.full(self.shape, np.inf)
        inside = distance_transform_edt(mask) if not mask.all() else np.full(self.shape, np.inf)
        most = float(np.linalg.norm(self.shape))
        signed = np.clip(outside, 0.0, most) - np.clip(inside, 0.0, most)
        signed = (signed - 0.5 * np.sign(signed)) * self.cell
        return GridDistance(self, torch.from_numpy(signed.astype(np.float32)))


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


# A scene without the matter that nobody saw: invented behind things, and in the way of cameras there.

_AROUND = 2
"""Voxels round measured surface whose matter stays."""


class MeasuredMatter:
    """The scene's matter near where a surface was measured, as a shell of a few voxels; made by ``without_unseen``."""

    def __init__(self, scene: SdfField, shell: GridDistance) -> None:
        self.scene = scene
        self._shell = shell
        if has_color(scene):
            self.color = scene.color

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: the scene's."""
        return self.scene.bounds

    @property
    def device(self) -> torch.device:
        return self.scene.device

    @property
    def observation(self) -> Observation | None:
        """The scene's."""
        return observation_of(self.scene)

    @property
    def inverse_deviation(self) -> float | None:
        """The scene's."""
        return inverse_deviation_of(self.scene)

    def to(self, device: torch.device | str) -> MeasuredMatter:
        """The same with its parameters on another device."""
        return MeasuredMatter(self.scene.to(device), self._shell)

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        points = points.to(device=self.device, dtype=torch.float32)
        return torch.maximum(self.scene.signed_distance(points).to(points), self._shell.at(points))

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        points = points.to(device=self.device, dtype=torch.float32)
        distance, gradient = (value.to(points) for value in self.scene.signed_distance_and_gradient(points))
        shell, slope = self._shell.at_with_gradient(points)
        beyond = shell > distance
        return torch.where(beyond, shell, distance), torch.where(beyond[:, None], slope, gradient)


def without_unseen(scene: SdfField) -> SdfField:
    """The scene without unobserved matter; itself where it does not know what was observed."""
    if observation_of(scene) is None:
        return scene
    near, origin = near_origin(scene)
    measured = _measured(near, observation_of(near))
    return TransformedField(measured, Sim3.from_translation(-origin)) if origin.any() else measured


def _measured(scene: SdfField, known: Observation | None) -> MeasuredMatter:
    assert known is not None
    shape = torch.tensor(known.states.shape, dtype=torch.float64)
    box = OrientedBox(known.low + known.voxel * shape / 2, known.voxel * shape, torch.eye(3, dtype=torch.float64))
    cell = known.voxel
    if known.T_grid_frame is not None:
        back = known.T_grid_frame.inverse()
        box = OrientedBox(back.apply(box.center[None])[0], box.size * back.scale, back.rotation)
        cell = cell * float(back.scale)
    x, y, z = known.states.shape
    surface = (known.states == SURFACE).numpy()
    near = np.asarray(binary_dilation(surface, iterations=_AROUND))
    return MeasuredMatter(scene, RegionGrid(box, cell, (x, y, z)).distance_to(near))

"""Coarse depth images of a field, as cameras at given places would have taken them: by sphere tracing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.geometry.pinhole import PinholeCameras
from regnf_core.surface.cameras import Rays
from regnf_core.surface.sphere_tracing import clip_to_region, free_lengths, shortest_step


@dataclass(frozen=True, eq=False)
class TracedDepths:
    """One image. free: (H, W) float32, depths along the camera's axis up to which its rays are free, 0 where nothing is
    known · meets: (H, W) bool, whether a surface ends them there."""

    free: Tensor
    meets: Tensor

    def places(self) -> Tensor:
        """(H, W, 2) float64, the image coordinates of its rays."""
        return _places(*self.free.shape)

    def around(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """The least and the largest depth (M,), (M,) of the four rays round image coordinates (M, 2)."""
        height, width = self.free.shape
        size = torch.tensor([width, height], dtype=places.dtype)
        first = (places * size - 0.5).floor().long()
        column, row = first.unbind(-1)
        columns = [column.clamp(0, width - 1), (column + 1).clamp(0, width - 1)]
        rows = [row.clamp(0, height - 1), (row + 1).clamp(0, height - 1)]
        depths = [self.free.view(-1)[y * width + x] for x in columns for y in rows]
        least = torch.minimum(torch.minimum(depths[0], depths[1]), torch.minimum(depths[2], depths[3]))
        largest = torch.maximum(torch.maximum(depths[0], depths[1]), torch.maximum(depths[2], depths[3]))
        return least, largest


def trace_depths(field: SdfField, cameras: PinholeCameras, rays_each: int) -> list[TracedDepths]:
    """An image a camera, of about ``rays_each`` rays, evenly spread over it. The region is the field's bounds."""
    return [_image(field, cameras, camera, rays_each) for camera in range(len(cameras))]


def _image(field: SdfField, cameras: PinholeCameras, camera: int, count: int) -> TracedDepths:
    width = max(2, round(math.sqrt(count * float(cameras.aspect[camera]))))
    height = max(2, round(count / width))
    places = _places(height, width).view(-1, 2)
    free, meets = free_depths(field, cameras.positions[camera], cameras.directions(camera, places))
    return TracedDepths(free.view(height, width), meets.view(height, width))


def _places(height: int, width: int) -> Tensor:
    rows = (torch.arange(height, dtype=torch.float64) + 0.5) / height
    columns = (torch.arange(width, dtype=torch.float64) + 0.5) / width
    return torch.stack([columns.expand(height, width), rows[:, None].expand(height, width)], -1)


def free_depths(field: SdfField, position: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """How often its direction (M, 3) each ray from ``position`` is free, (M,), and whether it ends at a surface."""
    lengths = directions.norm(dim=-1)
    rays = Rays(position.expand_as(directions).float(), (directions / lengths[:, None]).float())
    low, high = field.bounds
    entry, exit_ = clip_to_region(rays, low, high)
    free, meets = free_lengths(field, rays, entry, exit_, shortest_step(float((high - low).norm())))
    return free / lengths.float(), meets

"""Pinhole cameras that stood somewhere: their rays, and where points lie in their images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle


@dataclass(frozen=True, eq=False)
class PinholeCameras(Bundle):
    """N cameras of one frame. Image coordinates are shares of the image's width and height, from 0 to 1.

    positions: (N, 3) · axes: (N, 3, 3), rotations whose columns are right, down and forward · focal: (N, 2), focal
    lengths over width and height · middle: (N, 2), the principal points · aspect: (N,), width over height. float64.
    """

    positions: Tensor
    axes: Tensor
    focal: Tensor
    middle: Tensor
    aspect: Tensor

    def __len__(self) -> int:
        return int(self.positions.shape[0])

    def moved(self, transform: Tensor) -> PinholeCameras:
        """The same cameras in another frame; transform: (4, 4), a similarity from this frame to the other."""
        transform = transform.to(self.positions)
        linear, shift = transform[:3, :3], transform[:3, 3]
        turn = linear / torch.linalg.det(linear) ** (1.0 / 3.0)
        return PinholeCameras(self.positions @ linear.T + shift, turn @ self.axes, self.focal, self.middle, self.aspect)

    def evenly(self, most: int) -> PinholeCameras:
        """At most ``most`` of them, evenly spread over their order."""
        count = min(len(self), most)
        return self[(torch.arange(count) * len(self)) // count]

    def directions(self, camera: int, places: Tensor) -> Tensor:
        """(M, 3), of the rays through image coordinates (M, 2): as long as reaches one unit along the camera's axis."""
        slopes = (places.double() - self.middle[camera]) / self.focal[camera]
        rays: Tensor = torch.cat([slopes, torch.ones(len(slopes), 1, dtype=slopes.dtype)], 1) @ self.axes[camera].T
        return rays

    def project(self, camera: int, points: Tensor) -> tuple[Tensor, Tensor]:
        """Image coordinates (M, 2) and depths (M,) along the camera's axis of points (M, 3).

        The coordinates mean nothing where the depth is not above 0.
        """
        local = (points - self.positions[camera].to(points)) @ self.axes[camera].to(points)
        depth = local[:, 2]
        slopes = local[:, :2] / depth.clamp_min(1e-9)[:, None]
        return slopes * self.focal[camera].to(points) + self.middle[camera].to(points), depth

"""Rays through the pixels of posed images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.geometry.ray_box import ray_box_interval
from regnf_data.posed_images import PosedImages
from regnf_fit.images.depth_normals import LocalPlanes


@dataclass(frozen=True)
class PixelRays:
    """R rays, one a pixel, world frame.

    A point at depth z lies at origins + z directions: directions (R, 3) are not of unit length, their part along the
    camera's axis is 1. near, far: (R,) depths between which the ray is inside the bounds · colors: (R, 3) in [0, 1] ·
    depths: (R,), 0 where none was measured · background: (R,) true where a mask says so · cosines: (R,) between ray
    and surface normal, 0 where unknown · deviations: (R,) of the depths' noise, 0 where unknown · images: (R,) the
    number of each one's image.
    """

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor
    colors: Tensor
    depths: Tensor
    background: Tensor
    cosines: Tensor
    deviations: Tensor
    images: Tensor

    def __len__(self) -> int:
        return self.origins.shape[0]

    def take(self, index: Tensor) -> PixelRays:
        """The rays at ``index`` (M,), or where a mask (R,) is true."""
        return PixelRays(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def to(self, device: torch.device) -> PixelRays:
        """The same rays on another device."""
        return PixelRays(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))

    def at(self, depths: Tensor) -> Tensor:
        """Points (R, S, 3) at depths (R, S)."""
        return self.origins[:, None] + depths[..., None] * self.directions[:, None]


def measured_within(rays: PixelRays) -> Tensor:
    """(R,) bool: which rays have a depth, and it ends within the bounds."""
    # near is 0 where a camera stands within the bounds, and so is a depth that was not measured
    return (rays.depths > 0.0) & (rays.depths >= rays.near) & (rays.depths <= rays.far) & ~rays.background


def rays_of_pixels(images: PosedImages, pixels: NDArray[np.int64], planes: LocalPlanes | None) -> PixelRays:
    """The rays of ``pixels`` (R,), indices into the images' (N, H, W) taken as one row.

    planes: of the images' depths.
    """
    image, row, column = np.unravel_index(pixels, images.colors.shape[:3])
    centers = np.stack([column + 0.5, row + 0.5, np.ones(len(pixels))], axis=-1)
    T_world_pixel = images.T_world_camera[:, :3, :3] @ np.linalg.inv(images.intrinsics)
    directions = np.einsum("rij,rj->ri", T_world_pixel[image], centers)
    origins = images.T_world_camera[image, :3, 3]
    bounds = torch.from_numpy(images.bounds)
    near, far = ray_box_interval(torch.from_numpy(origins), torch.from_numpy(directions), bounds[0], bounds[1])

    def picked(values: NDArray[np.generic] | None) -> Tensor:
        if values is None:
            return torch.zeros(len(pixels))
        return torch.from_numpy(values[image, row, column]).float()

    return PixelRays(
        origins=torch.from_numpy(origins).float(),
        directions=torch.from_numpy(directions).float(),
        near=near.float(),
        far=far.float(),
        colors=picked(images.colors) / 255.0 if len(pixels) else torch.zeros(0, 3),
        depths=picked(images.depths),
        background=picked(None if images.masks is None else ~images.masks) > 0.5,
        cosines=picked(None if planes is None else planes.cosines),
        deviations=picked(None if planes is None else planes.deviations),
        images=torch.from_numpy(image),
    )


def pixel_axes(images: PosedImages) -> Tensor:
    """(N, 2, 3) float32: by what a ray's direction changes to the pixel right of its own, and to the one below it."""
    T_world_pixel = images.T_world_camera[:, :3, :3] @ np.linalg.inv(images.intrinsics)
    return torch.from_numpy(T_world_pixel[:, :, :2].transpose(0, 2, 1).copy()).float()

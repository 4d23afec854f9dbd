"""A pinhole camera that one frame is taken by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.geometry.box import OrientedBox
from regnf_core.rendering.request import OrbitRequest, check_extent
from regnf_core.surface.sphere_tracing import Rays, axis_vector

_RIGHT_ANGLES = 1e-4
_WIDEST_DEG = 170.0


def invalid_camera(message: str) -> InvalidInputError:
    return InvalidInputError(message, reason="CAMERA_INVALID")


@dataclass(frozen=True, eq=False)
class Camera:
    """Where a frame is taken from, and its pixels.

    position: (3,) and axes: (3, 3), columns right, down and forward, in the scene's frame (OpenCV's axes), float64 ·
    width, height: pixels · focal, middle: (2,) along width and height, pixels; a pixel's middle is at .5.
    Raises InvalidInputError: CAMERA_INVALID, RENDER_TOO_LARGE.
    """

    position: Tensor
    axes: Tensor
    width: int
    height: int
    focal: tuple[float, float]
    middle: tuple[float, float]

    def __post_init__(self) -> None:
        for name, shape in (("position", (3,)), ("axes", (3, 3))):
            value = torch.as_tensor(getattr(self, name), dtype=torch.float64, device="cpu")
            if tuple(value.shape) != shape or not torch.isfinite(value).all():
                raise invalid_camera(f"a camera's {name} must have {math.prod(shape)} finite numbers")
            object.__setattr__(self, name, value)
        off = (self.axes.T @ self.axes - torch.eye(3, dtype=torch.float64)).abs().max()
        if not off <= _RIGHT_ANGLES or torch.det(self.axes) < 0:
            raise invalid_camera("a camera's axes are not a rotation")
        if self.width < 1 or self.height < 1:
            raise invalid_camera("a camera's image must have at least one pixel along each side")
        if not all(math.isfinite(one) and one > 0 for one in self.focal):
            raise invalid_camera("a camera's focal lengths must be above 0")
        if not all(math.isfinite(one) for one in self.middle):
            raise invalid_camera("a camera's principal point must be finite")
        check_extent(1, self.width * self.height)

    @classmethod
    def look_at(
        cls,
        position: Sequence[float] | Tensor,
        target: Sequence[float] | Tensor,
        size: tuple[int, int] = (640, 480),
        field_of_view_deg: float = 50.0,
        up: str | Sequence[float] | Tensor = "z",
    ) -> Camera:
        """A camera at ``position`` (3,) whose middle shows ``target`` (3,), scene frame.

        size: width and height · field_of_view_deg: across the width · up: "x", "y", "z", each also with "-", or a
        vector (3,). Looking straight along ``up``, another axis is taken for it.
        """
        if not 0.0 < field_of_view_deg <= _WIDEST_DEG:
            raise invalid_camera(f"a field of view must be above 0 and at most {_WIDEST_DEG:g} degrees")
        at, to = (torch.as_tensor(value, dtype=torch.float64) for value in (position, target))
        if at.shape != (3,) or to.shape != (3,) or not torch.isfinite(torch.stack([at, to])).all():
            raise invalid_camera("a camera's position and target must have three finite numbers each")
        forward = to - at
        if not forward.norm() > 1e-12:
            raise invalid_camera("a camera's position and target must differ")
        focal = size[0] / 2.0 / math.tan(math.radians(field_of_view_deg) / 2.0)
        forward, up = forward / forward.norm(), up_vector(up)
        right = torch.linalg.cross(forward, up)
        if right.norm() < 1e-6:
            right = torch.linalg.cross(forward, torch.eye(3, dtype=torch.float64)[int(forward.abs().argmin())])
        right = right / right.norm()
        axes = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
        return cls(at, axes, size[0], size[1], (focal, focal), (size[0] / 2.0, size[1] / 2.0))

    def rays(self, pixels: Tensor, offset: tuple[float, float] = (0.5, 0.5)) -> tuple[Rays, Tensor]:
        """Rays through pixels (N,), numbered row by row, and the cosines (N,) of their angles to the viewing axis.

        offset: where in the pixel, along width and height, 0..1. A depth is the length along the ray times the cosine.
        """
        u = (pixels % self.width + offset[0] - self.middle[0]) / self.focal[0]
        v = (pixels // self.width + offset[1] - self.middle[1]) / self.focal[1]
        local = torch.stack([u, v, torch.ones_like(u)], dim=-1).double()
        length = local.norm(dim=-1, keepdim=True)
        directions = (local / length) @ self.axes.to(local).T
        origins = self.position.to(directions).float().expand(len(directions), 3)
        return Rays(origins, directions.float()), (1.0 / length.squeeze(-1)).float()

    def resized(self, size: tuple[int, int]) -> Camera:
        """The same view in an image of ``size`` (width, height); pixels may become oblong."""
        x, y = size[0] / self.width, size[1] / self.height
        focal, middle = (self.focal[0] * x, self.focal[1] * y), (self.middle[0] * x, self.middle[1] * y)
        return Camera(self.position, self.axes, size[0], size[1], focal, middle)


def up_vector(up: str | Sequence[float] | Tensor) -> Tensor:
    """(3,) unit float64 of "x", "-y" and the like, or of a vector. Raises InvalidInputError (CAMERA_INVALID)."""
    if isinstance(up, str):
        if up.removeprefix("-") not in ("x", "y", "z"):
            raise invalid_camera(f"up must be x, y, z, -x, -y, -z or a vector, not {up[:20]!r}")
        return axis_vector(up[-1]) * (-1.0 if up.startswith("-") else 1.0)
    vector = torch.as_tensor(up, dtype=torch.float64)
    if vector.shape != (3,) or not torch.isfinite(vector).all() or not vector.norm() > 1e-12:
        raise invalid_camera("up must be a vector of three finite numbers, not all zero")
    unit: Tensor = vector / vector.norm()
    return unit


# One rendered picture with everything that is known at its pixels.

NOTHING = -1
"""The part of a pixel whose ray meets nothing."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Row by row, the top row first.

    depth: (H, W) float32 along the camera's viewing axis (not along the ray), scene units; 0 where nothing is met ·
    normal: (H, W, 3) float32 unit, scene frame, towards free space; 0 where nothing is met · color: (H, W, 3) uint8
    sRGB · opacity: (H, W) float32, 0..1 · part: (H, W) int16: NOTHING, 0 for the scene, k + 1 for edit k's object.
    """

    camera: Camera
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    color: NDArray[np.uint8]
    opacity: NDArray[np.float32]
    part: NDArray[np.int16]


_ROOM_AROUND = 1.25
"""How much farther a camera of an orbit stands than fills the image with the box."""


def orbit_cameras(orbit: OrbitRequest, box: OrientedBox, size: tuple[int, int] = (640, 480)) -> list[Camera]:
    """Cameras on a circle round ``box``, all looking at its middle. size: width and height.

    A full turn ends one step before its start. Without a distance, a ball that holds the box is in view.
    """
    up, full = up_vector(orbit.up), abs(orbit.sweep_deg) >= 360.0
    steps = orbit.frames if full else max(orbit.frames - 1, 1)
    first = torch.eye(3, dtype=torch.float64)[(int(up.abs().argmax()) + 1) % 3]
    second = torch.linalg.cross(up, first)
    half = math.radians(orbit.field_of_view_deg) / 2.0
    narrower = min(half, math.atan(math.tan(half) * size[1] / size[0]))
    away = orbit.distance or _ROOM_AROUND * 0.5 * box.diagonal / math.sin(narrower)
    tilt = math.radians(orbit.elevation_deg)
    found = []
    for frame in range(orbit.frames):
        turn = math.radians(orbit.start_deg + orbit.sweep_deg * frame / steps)
        level = math.cos(turn) * first + math.sin(turn) * second
        position = box.center + away * (math.cos(tilt) * level + math.sin(tilt) * up)
        found.append(Camera.look_at(position, box.center, size, orbit.field_of_view_deg, up))
    return found

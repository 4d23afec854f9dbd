"""RGB-D images of a mesh scene, as an ideal camera would take them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.mesh_scene import MeshScene, to_srgb

Size = tuple[int, int]
"""Height and width, pixels."""

_BACKGROUND = (1.0, 1.0, 1.0)
_FINE = 3
"""Rays along each side of a pixel, an odd number: the one in the middle gives the depth."""


_TO_LAMP, _LAMP, _AMBIENT = (0.5, 0.35, 0.8), 0.55, 0.45
"""The shares of full light are together 1 at most, so that nothing is overexposed."""


def light(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,): on surfaces with unit normals (P, 3), by Lambert's cosine law under one far lamp, and from all around, a
    little more from above."""
    shone: NDArray[np.float64] = _LAMP * np.maximum(normals @ (np.array(_TO_LAMP) / np.linalg.norm(_TO_LAMP)), 0.0)
    return shone + _AMBIENT * (0.8 + 0.2 * normals[:, 2])


@dataclass(frozen=True)
class View:
    """One image. colors: (H, W, 3) uint8 sRGB · depth: (H, W) along the camera's z axis, 0 where nothing is ·

    cosine: (H, W) between the ray and the surface's normal · thing: (H, W) index of the thing seen, -1 for none.
    """

    colors: NDArray[np.uint8]
    depth: NDArray[np.float64]
    cosine: NDArray[np.float64]
    thing: NDArray[np.int64]


def intrinsics_of(size: Size, field_of_view_deg: float) -> NDArray[np.float64]:
    """(3, 3): square pixels, the axis through the image's middle, ``field_of_view_deg`` across its width."""
    height, width = size
    focal = width / 2.0 / math.tan(math.radians(field_of_view_deg) / 2.0)
    return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])


def camera_rays(
    size: Size, intrinsics: NDArray[np.float64], T_scene_camera: NDArray[np.float64], fine: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origins and directions (R, 3) through the middles of ``fine`` x ``fine`` parts of every pixel, row by row.

    A direction's part along the camera's axis is 1: distances along the rays are depths.
    """
    rows, columns = ((np.arange(count * fine) + 0.5) / fine for count in size)
    v, u = np.meshgrid(rows, columns, indexing="ij")
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    directions = (T_scene_camera[:3, :3] @ np.linalg.inv(intrinsics) @ pixels).T
    return np.broadcast_to(T_scene_camera[:3, 3], directions.shape), directions


def render(
    scene: MeshScene,
    size: Size,
    intrinsics: NDArray[np.float64],
    T_scene_camera: NDArray[np.float64],
) -> View:
    """The scene from one camera, depth at the pixels' middles, colors the mean over 3 x 3 rays a pixel.

    size: height and width · intrinsics: (3, 3) · T_scene_camera: (4, 4), a rotation and a translation, OpenCV's axes.
    """
    origins, directions = camera_rays(size, intrinsics, T_scene_camera, _FINE)
    hits = scene.cast(origins, directions)
    height, width = size
    shaded = hits.color * light(hits.normal)[:, None]
    shaded[hits.thing < 0] = _BACKGROUND

    def middles(values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(height * _FINE, width * _FINE)[_FINE // 2 :: _FINE, _FINE // 2 :: _FINE]

    cosine = -np.einsum("rc,rc->r", hits.normal, directions) / np.linalg.norm(directions, axis=1)
    depth = middles(hits.distance)
    return View(
        colors=to_srgb(shaded.reshape(height, _FINE, width, _FINE, 3).mean(axis=(1, 3))),
        depth=np.where(np.isfinite(depth), depth, 0.0),
        cosine=middles(cosine),
        thing=middles(hits.thing),
    )


# The errors of a depth camera that projects light (structured light, time of flight).

_NGUYEN_WIDTH = 640
"""Pixels across the images that the lateral error was measured in."""


@dataclass(frozen=True)
class DepthSensor:
    """Depth noise. Axial and lateral errors by Nguyen, Izadi and Lovell (2012) for the first Kinect.

    "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012: the axial deviation at
    depth z is .0012 + .0019 (z - .4)^2 meters, the lateral one .8 pixels of an image 640 wide. Their further terms
    for surfaces seen at more than 60 degrees are left out; beyond ``grazing_deg`` readings are lost instead.
    """

    nearest_m: float = 0.4
    farthest_m: float = 5.0
    step_m: float = 0.001
    """Readings are whole multiples of this."""
    lateral_pixels: float = 0.8
    grazing_deg: float = 80.0
    """Surfaces seen at a larger angle from their normal give no reading."""
    edge_jump_m: float = 0.05
    edge_dropout: float = 0.2
    """The share of readings lost where the depth jumps by ``edge_jump_m`` or more; a choice, for small images."""

    def deviation_m(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of the axial error at depths in meters."""
        return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2

    def measure(
        self, exact: NDArray[np.float64], cosine: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """What the sensor reads of an exact depth image (H, W), 0 where it reads nothing; meters.

        cosine: (H, W), between the ray and the surface's normal.
        """
        lost = cosine < np.cos(np.radians(self.grazing_deg))
        lost |= jumps(exact, self.edge_jump_m) & (rng.random(exact.shape) < self.edge_dropout)
        seen = self._sideways(exact, rng)
        read = seen + self.deviation_m(seen) * rng.normal(size=exact.shape)
        read = np.round(read / self.step_m) * self.step_m
        lost |= (exact <= 0.0) | (seen <= 0.0) | (read < self.nearest_m) | (read > self.farthest_m)
        return np.where(lost, 0.0, read)

    def _sideways(self, depth: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Every pixel's depth taken from a neighbor that lies as far as the lateral error says, mostly itself."""
        height, width = depth.shape
        shift = rng.normal(scale=self.lateral_pixels * width / _NGUYEN_WIDTH, size=(2, height, width))
        rows, columns = np.indices(depth.shape) + np.round(shift).astype(np.int64)
        shifted: NDArray[np.float64] = depth[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return shifted


def jumps(depth: NDArray[np.float64], jump: float) -> NDArray[np.bool_]:
    """(H, W): pixels whose depth (H, W) is off by ``jump`` or more from the plane through its neighbors on two sides.

    On a plane, however slanted, 1 / z is linear in the pixels: only edges and the background (0) count.
    """
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
    bend = np.zeros_like(depth)
    bend[1:-1] = np.abs(inverse[:-2] + inverse[2:] - 2.0 * inverse[1:-1])
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], np.abs(inverse[:, :-2] + inverse[:, 2:] - 2.0 * inverse[:, 1:-1]))
    return np.asarray(bend * depth**2 >= jump)

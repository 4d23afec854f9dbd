"""RGB-D images of a mesh scene, as an ideal camera would take them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_data.mesh_scene import MeshScene, to_srgb

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

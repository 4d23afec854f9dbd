"""Pictures of worlds: two views of what stands there, a color a thing, with the light at the camera."""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.random_worlds.mesh import Array, ExactScene
from benchmarks.random_worlds.walks import World
from benchmarks.worlds.rendering import Size, intrinsics_of
from benchmarks.worlds.trajectories import look_at

_SIZE: Size = (480, 640)
_FIELD_OF_VIEW_DEG = 72.0
_GOLDEN = 0.618034
_GROUND = (0.78, 0.76, 0.72)


def picture(world: World) -> Image.Image:
    """The world from two sides, side by side; walls between the camera and the room are left out."""
    views = [_view(world, azimuth) for azimuth in ((-1.05, -2.1) if world.kind == "shelf" else (-1.05, 2.3))]
    return Image.fromarray(np.concatenate(views, axis=1))


def _view(world: World, azimuth: float) -> NDArray[np.uint8]:
    target, reach, rise = _framed(world)
    out = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
    position = target + reach * out
    kept = [
        placed for placed in world.all if placed.model is not None or not _before(placed.mesh.bounds, target, position)
    ]
    scene = ExactScene([placed.mesh for placed in kept])
    pose = look_at(position[None], target[None])[0]
    view = scene.view(_SIZE, intrinsics_of(_SIZE, _FIELD_OF_VIEW_DEG), pose)
    hues = [colorsys.hsv_to_rgb(number * _GOLDEN % 1.0, 0.55, 0.95) for number in range(len(kept))]
    colors = np.array([_GROUND if placed.model is None else hue for placed, hue in zip(kept, hues, strict=True)])
    shade = 0.25 + 0.75 * view.cosine[..., None]
    shown = np.where(view.thing[..., None] >= 0, colors[view.thing] * shade, 1.0)
    return np.asarray(np.round(255.0 * shown), dtype=np.uint8)


def _framed(world: World) -> tuple[Array, float, float]:
    """What to look at, from how far, and from what angle above."""
    if world.focus is None:
        size = world.floor[1] - world.floor[0]
        return np.array([0.0, 0.0, 0.4]), 0.78 * float(np.linalg.norm(size[:2])), 0.6
    low, high = world.focus.mesh.bounds
    target = np.array([*(low + high)[:2] / 2.0, high[2] if world.kind == "table" else high[2] / 2.0])
    return target, 0.85 * float(np.linalg.norm(high - low)) + 0.5, 0.45


def _before(bounds: Array, target: Array, position: Array) -> bool:
    """Whether a wall stands on the camera's side of the room."""
    middle = bounds.mean(axis=0)
    return bool(bounds[1, 2] > 0.0 and (middle - target)[:2] @ (position - target)[:2] > 0.0)

"""The depths that cameras see of a density: where half of the light is stopped (the median of the transmittance).

The density is sampled once, on the nodes of a lattice, and rays are followed through the lattice: that costs the same
for any number of cameras. Three of four layers of nodes are asked only where the others have found matter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from regnf_core.importing.radiance.density import RadianceField
from regnf_core.importing.splats.drawing import Camera
from regnf_core.importing.splats.gaussians import Doubles, Floats

_CLEAR = 1e-3
"""Of the light, what a step between nodes stops in free space, at most."""
_MOST = 1e6
_HALF = float(np.log(2.0))
_STEP = 0.5
"""Steps of the lattice along a ray, where there is matter."""
_AT_ONCE = 1 << 18
"""Nodes."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """values: (X, Y, Z), the density times ``step`` at low + step (i, j, k), zero in free space · clear: of blocks of
    2^3 nodes, how many blocks away the nearest one with matter is, at least."""

    low: Doubles
    step: float
    values: Floats
    clear: npt.NDArray[np.int32]


def sampled(field: RadianceField, low: Doubles, high: Doubles, nodes: int, workers: int) -> Lattice:
    """A field on ``nodes`` nodes along the longest edge of a box, half a step within its sides."""
    step = float((high - low).max()) / nodes
    blocks = np.maximum(np.ceil((high - low) / (2.0 * step)), 1).astype(np.int64)
    first = low + 0.5 * step
    values = np.zeros(2 * blocks, np.float32)
    with ThreadPoolExecutor(workers) as pool:

        def asked(index: npt.NDArray[np.int64]) -> None:
            parts = np.array_split(index, max(1, len(index) // _AT_ONCE))
            for part, found in zip(parts, pool.map(lambda p: _stopped(field, first, step, p), parts), strict=True):
                values[tuple(part.T)] = found

        asked(2 * np.argwhere(np.ones(blocks, np.bool_)))
        matter = ndimage.binary_dilation(values[::2, ::2, ::2] > _CLEAR, np.ones((3, 3, 3), np.bool_))
        corners = 2 * np.argwhere(matter)
        for offset in list(np.ndindex(2, 2, 2))[1:]:
            asked(corners + offset)
    values[values <= _CLEAR] = 0.0
    matter = values.reshape(blocks[0], 2, blocks[1], 2, blocks[2], 2).any(axis=(1, 3, 5))
    away = ndimage.distance_transform_cdt(~matter) if matter.any() else np.full(blocks, max(blocks))
    return Lattice(first, step, values, np.asarray(away, np.int32))


def _stopped(field: RadianceField, first: Doubles, step: float, index: npt.NDArray[np.int64]) -> Floats:
    """(N,): the density times the step; what is no number counts as free."""
    with np.errstate(all="ignore"):
        found = step * field.density(first + step * index)
        return np.asarray(np.nan_to_num(found, nan=0.0, posinf=_MOST).clip(0.0, _MOST), np.float32)


def depth_images(lattice: Lattice, cameras: Sequence[Camera], near: float, workers: int) -> list[Floats]:
    """(H, W) each, along the camera's axis, 0 where less than half of the light is stopped. near: from where on."""
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(lambda camera: _depth_image(lattice, camera, near), cameras))


def _depth_image(lattice: Lattice, camera: Camera, near: float) -> Floats:
    width, height = camera.size
    row, column = np.indices((height, width)).reshape(2, -1) + 0.5
    pixels = np.stack([column, row, np.ones_like(row)], axis=1)
    T_world_camera = np.linalg.inv(camera.T_camera_world)
    ahead = pixels @ np.linalg.inv(camera.matrix).T @ T_world_camera[:3, :3].T
    length = np.linalg.norm(ahead, axis=1)
    # In steps of the lattice from here on.
    start = (T_world_camera[:3, 3] - lattice.low) / lattice.step
    found = np.zeros(len(row))
    for rays, at in _crossings(lattice, start, ahead / length[:, None], near / lattice.step):
        found[rays] = at
    return np.asarray(lattice.step * found / length, np.float32).reshape(height, width)


def _crossings(
    lattice: Lattice, start: Doubles, unit: Doubles, near: float
) -> Iterator[tuple[npt.NDArray[np.int64], Doubles]]:
    """Numbers of rays, and how far along them half of the light is stopped. start: (3,) · unit: (N, 3)."""
    last = np.array(lattice.values.shape) - 1.0
    with np.errstate(all="ignore"):  # a ray along an axis has no crossing with the others' planes
        sides = np.stack([-start / unit, (last - start) / unit])
    begin = np.maximum(np.nanmax(sides.min(axis=0), axis=1), near)
    end = np.nanmin(sides.max(axis=0), axis=1)
    rays = np.flatnonzero(begin < end)
    at, before, light = begin[rays], np.zeros(len(rays)), np.zeros(len(rays))
    across, clear = lattice.clear.shape, lattice.clear.ravel()
    while len(rays):
        places = start[:, None] + at * unit.T[:, rays]
        x, y, z = (np.minimum(own.astype(np.int32) >> 1, most - 1) for own, most in zip(places, across, strict=True))
        away = clear[(x * across[1] + y) * across[2] + z]
        here = np.zeros(len(rays))
        close = np.flatnonzero(away <= 1)
        here[close] = ndimage.map_coordinates(lattice.values, places[:, close], order=1, mode="nearest")
        gained = _STEP * (before + here) / 2.0
        crossed = light + gained >= _HALF
        if crossed.any():
            back = (light + gained - _HALF)[crossed] / gained[crossed]
            yield rays[crossed], np.maximum(at[crossed] - _STEP * back, near)
        light, before = light + gained, here
        at = at + np.where(away > 1, 2.0 * (away - 1), _STEP)
        going = np.flatnonzero(~crossed & (at < end[rays]))
        rays, at, before, light = rays[going], at[going], before[going], light[going]

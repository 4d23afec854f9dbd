"""How far depths of one surface lie apart from image to image: the sensor's noise and the poses' errors together.

A plane through neighboring pixels shows the noise that differs from pixel to pixel. What the pixels of one image share
shows only beside other images: errors of its pose, and of a sensor's calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from regnf_data.posed_images import PosedImages

Floats = NDArray[np.float64]

_PAIRS, _PIXELS = 600, 500
"""Pairs of images that are drawn, and pixels of the first that are looked up in the second."""
_SAME_SURFACE = 0.04
"""Depths that differ by a larger share lie on different surfaces, as in depth_normals.py."""
_BINS, _LEAST_IN_BIN = 8, 200
_MAD_TO_DEVIATION = 1.4826
_REACH = 3.0
"""Deviations that count as the same surface, once the deviation is known."""
_ROUNDS = 20


@dataclass(frozen=True)
class DepthSpread:
    """The standard deviation (K,) across a surface, world units, of depths about (K,) ascending; none where K = 0."""

    depths: Floats
    deviations: Floats

    def at(self, depths: NDArray[np.float32]) -> NDArray[np.float32]:
        """The deviation at each of the depths (R,), 0 where nothing is known."""
        if len(self.depths) == 0:
            return np.zeros_like(depths)
        return np.interp(depths, self.depths, self.deviations).astype(np.float32)

    def median(self, depths: NDArray[np.float32]) -> float:
        """The deviation in the median over the depths (R,), at least one."""
        return float(np.median(self.at(depths)))


NO_SPREAD = DepthSpread(np.zeros(0), np.zeros(0))
"""Nothing is known."""


def depth_spread(images: PosedImages, cosines: NDArray[np.float32]) -> DepthSpread:
    """From pixels of one image that are seen in another too. Deterministic.

    cosines: (N, H, W) between ray and surface normal, 0 where unknown: such pixels are left out. Without overlapping
    images, or without depths, nothing is known.
    """
    if images.depths is None or len(images) < 2:
        return NO_SPREAD
    rng = np.random.default_rng(0)
    pairs = rng.integers(len(images), size=(_PAIRS, 2))
    found = [_differences(images, cosines, first, second, rng) for first, second in pairs if first != second]
    return _by_depth(np.concatenate([depth for depth, _ in found]), np.concatenate([apart for _, apart in found]))


def _differences(
    images: PosedImages, cosines: NDArray[np.float32], first: int, second: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Depths (M,) in the second image where pixels of the first fall, each the mean of both, and how far the first's
    lie before or behind, across the surface; those too far off to be of the same surface are left out."""
    assert images.depths is not None
    height, width = images.size
    pixels = rng.integers(height * width, size=_PIXELS)
    depth = images.depths[first].reshape(-1)[pixels].astype(np.float64)
    row, column = np.divmod(pixels, width)
    rays = np.stack([column + 0.5, row + 0.5, np.ones(_PIXELS)], axis=-1) @ np.linalg.inv(images.intrinsics[first]).T
    T = np.linalg.inv(images.T_world_camera[second]) @ images.T_world_camera[first]
    seen = (rays * depth[:, None])[depth > 0.0] @ T[:3, :3].T + T[:3, 3]
    seen = seen[seen[:, 2] > 0.0]
    places = seen @ images.intrinsics[second].T
    column, row = np.floor(places[:, :2] / places[:, 2:]).astype(np.int64).T
    shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    seen, column, row = seen[shown], column[shown], row[shown]
    measured = images.depths[second][row, column].astype(np.float64)
    cosine = cosines[second][row, column].astype(np.float64)
    length = np.linalg.norm(seen, axis=1) / seen[:, 2]  # of the ray, a unit of depth
    same = (cosine > 0.0) & (measured > 0.0) & (np.abs(seen[:, 2] - measured) < _SAME_SURFACE * measured)
    apart = (seen[:, 2] - measured) * length * cosine
    # the mean does not depend on the difference, as either depth does: bins of it have the differences of all
    return ((seen[:, 2] + measured) / 2.0)[same], apart[same]


def _by_depth(depths: Floats, apart: Floats) -> DepthSpread:
    """The deviation of one image's depths: the difference of two has sqrt(2) times as much."""
    count = min(_BINS, len(depths) // _LEAST_IN_BIN)
    if count == 0:
        return NO_SPREAD
    parts = np.array_split(np.argsort(depths), count)
    deviations = [_deviation(apart[part]) / sqrt(2.0) for part in parts]
    return DepthSpread(np.array([np.median(depths[part]) for part in parts]), np.array(deviations))


def _deviation(values: Floats) -> float:
    """The standard deviation of most of the values, whatever the others are."""
    size = np.abs(values)
    reach = float(size.max())
    for _ in range(_ROUNDS):
        reach = min(reach, _REACH * _MAD_TO_DEVIATION * float(np.median(size[size <= reach])))
    return reach / _REACH

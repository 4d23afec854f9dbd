"""The errors of three kinds of depth cameras: structured light, time of flight, stereo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.float64]
Kind = Literal["structured light", "time of flight", "stereo"]
KINDS: tuple[Kind, ...] = ("structured light", "time of flight", "stereo")
_JUMP = 0.012
"""A share of the depth: neighbors that differ by more lie on different surfaces."""


@dataclass(frozen=True)
class Surfaces:
    """What surfaces are like, (H, W) bool each: dark ones reflect little, bare ones have no texture."""

    dark: NDArray[np.bool_]
    bare: NDArray[np.bool_]


def measure(
    kind: Kind, exact: Image, cosine: Image, surfaces: Surfaces, focal: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """What a sensor reads of an exact depth image (H, W), meters, 0 where nothing is. cosine: of ray and normal."""
    depth = np.where(exact > 0.0, exact, 12.0)
    sensor = {"structured light": _structured, "time of flight": _flight, "stereo": _stereo}[kind]
    read, lost = sensor(depth, surfaces, focal, rng)
    lost |= (exact <= 0.0) | (cosine < np.cos(np.radians(rng.uniform(78.0, 84.0)))) | (read < 0.2) | (read > 8.0)
    return np.where(lost, 0.0, read).astype(np.float32)


def _structured(depth: Image, surfaces: Surfaces, focal: float, rng: np.random.Generator) -> tuple[Image, Any]:
    """Disparities of a projected pattern in steps of an eighth of a pixel, means over a window; the axial error by
    Nguyen, Izadi and Lovell (2012)."""
    reach = focal * 0.075
    disparity = reach / depth
    edge = _edges(depth)
    smooth = np.where(
        ndimage.binary_dilation(edge, iterations=2),
        ndimage.median_filter(disparity, 5),
        ndimage.gaussian_filter(disparity, 1.5),
    )
    deviation = (0.0012 + 0.0019 * (depth - 0.4) ** 2) * disparity / depth
    smooth += deviation * _correlated(depth.shape, 0.7, rng) * np.where(surfaces.dark, 2.0, 1.0)
    read = reach / np.maximum(np.round(smooth * 8.0) / 8.0, 0.125)
    draw = rng.random(depth.shape)
    flying = edge & (draw < 0.15)
    read = np.where(flying, _mixed(depth, rng), read)
    return read, _shadow(disparity) | (edge & (draw > 0.8))


def _flight(depth: Image, surfaces: Surfaces, _focal: float, rng: np.random.Generator) -> tuple[Image, Any]:
    """Depths mixed at edges, and too long where light takes other ways."""
    edge = _edges(depth)
    bias = rng.uniform(0.0, 0.004) + rng.uniform(0.001, 0.003) * _correlated(depth.shape, 40.0, rng)
    noise = (0.0012 + 0.001 * depth**2) * np.where(surfaces.dark, 3.0, 1.0) * rng.normal(size=depth.shape)
    draw = rng.random(depth.shape)
    read = np.where(edge & (draw < 0.6), _mixed(depth, rng), depth) + bias + noise
    return np.round(read, 3), (edge & (draw > 0.85)) | (surfaces.dark & (draw < 0.1))


def _stereo(depth: Image, surfaces: Surfaces, focal: float, rng: np.random.Generator) -> tuple[Image, Any]:
    """Disparities of windows: near things grow, edges become ramps, errors are alike nearby; holes without texture."""
    reach = focal * rng.uniform(0.05, 0.095)
    disparity = reach / depth
    grown = ndimage.grey_dilation(disparity, int(rng.integers(2, 5)))
    smooth = ndimage.gaussian_filter(grown, rng.uniform(0.7, 1.5))
    smooth += rng.uniform(0.06, 0.14) * _correlated(depth.shape, rng.uniform(2.0, 4.0), rng)
    read = reach / np.maximum(np.round(smooth * 32.0) / 32.0, 0.125)
    patches = _correlated(depth.shape, rng.uniform(3.0, 8.0), rng)
    holes = (surfaces.bare & (patches > rng.uniform(0.5, 1.5))) | (surfaces.dark & (patches < -rng.uniform(0.5, 1.5)))
    return read, _shadow(disparity) | holes


def _edges(depth: Image) -> NDArray[np.bool_]:
    """Pixels with another surface among their neighbors."""
    high, low = ndimage.maximum_filter(depth, 3), ndimage.minimum_filter(depth, 3)
    bend = np.abs(ndimage.laplace(1.0 / depth)) * depth
    edge: NDArray[np.bool_] = (high - low > _JUMP * depth) & (ndimage.maximum_filter(bend, 3) > _JUMP)
    return edge


def _mixed(depth: Image, rng: np.random.Generator) -> Image:
    high, low = ndimage.maximum_filter(depth, 3), ndimage.minimum_filter(depth, 3)
    mixed: Image = low + rng.random(depth.shape) * np.minimum(high - low, 0.5)
    return mixed


def _shadow(disparity: Image) -> NDArray[np.bool_]:
    """Pixels that a projector, or a second camera, beside the first does not see."""
    other = np.arange(disparity.shape[1]) - disparity
    after = np.minimum.accumulate(other[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(disparity.shape, dtype=np.bool_)
    hidden[:, :-1] = other[:, :-1] > after[:, 1:] + 0.5
    return hidden


def _correlated(shape: tuple[int, ...], pixels: float, rng: np.random.Generator) -> Image:
    """Gaussian noise (H, W) of deviation 1, alike over so many pixels."""
    step = max(1, int(pixels / 3.0))
    small = rng.normal(size=tuple(-(-side // step) + 1 for side in shape))
    noise = ndimage.gaussian_filter(small, pixels / step)
    noise = ndimage.zoom(noise, step, order=1) if step > 1 else noise
    noise = noise[: shape[0], : shape[1]]
    found: Image = noise / noise.std()
    return found

"""Frames as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from regnf_core.rendering.frame import Frame

_GAP = 6
"""Pixels between the pictures of a strip."""
_WHITE = 255
_FRAMES_A_SECOND = 12


def write_color(frame: Frame, path: Path) -> None:
    """PNG, 8 bits a channel, sRGB."""
    Image.fromarray(frame.color).save(path, format="PNG")


def write_normal(frame: Frame, path: Path) -> None:
    """PNG, 8 bits a channel: 0..255 for -1..1 along the scene's axes; (0, 0, 0) where nothing is met."""
    levels = np.rint((frame.normal + 1.0) * 127.5).astype(np.uint8)
    levels[frame.depth <= 0] = 0
    Image.fromarray(levels).save(path, format="PNG")


def write_depth(frame: Frame, png: Path, npy: Path, unit: float) -> None:
    """The depths as .npy (float32, scene units), and as PNG of 16 bits in ``unit``; 0 where nothing is met."""
    np.save(npy, frame.depth)
    levels = np.clip(np.rint(frame.depth / unit), 0, 65535).astype(np.uint16)
    Image.fromarray(levels).save(png, format="PNG")


def depth_unit(largest: float) -> float:
    """Scene units a level of a depth PNG, so that ``largest`` fits 16 bits: a power of ten, times 1, 2 or 5."""
    if largest <= 0:
        return 1.0
    least = largest / 65000.0
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= least))


def write_animation(pictures: Sequence[NDArray[np.uint8]], path: Path) -> None:
    """Animated WebP of pictures (H, W, 3), in a loop."""
    first, *others = [Image.fromarray(picture) for picture in pictures]
    duration = round(1000 / _FRAMES_A_SECOND)
    first.save(path, format="WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=80)


def strip(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures (H, W, 3) of one height side by side."""
    gap = np.full((pictures[0].shape[0], _GAP, 3), _WHITE, np.uint8)
    parts = [part for picture in pictures for part in (gap, picture)][1:]
    return np.concatenate(parts, axis=1)

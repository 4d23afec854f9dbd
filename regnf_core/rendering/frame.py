"""One rendered picture with everything that is known at its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from regnf_core.rendering.camera import Camera

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

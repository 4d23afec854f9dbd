"""A folder of recorded RGB-D frames with poses, as KinectFusion's example data lie in public repositories.

``camera-intrinsics.txt`` or ``intrinsics.K.txt`` (3 x 3) and, there or in the folder ``rgbd-frames``,
``frame-NNNNNN.depth.png`` (millimeters), ``.color.jpg`` or ``.color.png`` and ``.pose.txt`` (camera to world).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from regnf_core.geometry.sim3 import Sim3
from regnf_data.posed_images import PosedImages

Floats = NDArray[np.float64]

FARTHEST_M = 4.0
"""Depths beyond are left out: a structured-light camera's are mostly noise there."""
_INTRINSICS = ("camera-intrinsics.txt", "intrinsics.K.txt")
_PIXEL_CENTER = 0.5
"""The files count pixels from their centers, PosedImages from their corners."""
_MILLIMETERS = 1000.0


@dataclass(frozen=True)
class Recording:
    """folder: of the frames · names: theirs, in order · intrinsics: (3, 3), pixels counted from their centers."""

    folder: Path
    names: tuple[str, ...]
    intrinsics: Floats

    def __len__(self) -> int:
        return len(self.names)

    def depth(self, frame: int) -> NDArray[np.float32]:
        """(H, W) meters; 0 where nothing was measured, or only beyond FARTHEST_M."""
        raw = np.asarray(Image.open(self.folder / f"{self.names[frame]}.depth.png"))
        meters = raw.astype(np.float32) / np.float32(_MILLIMETERS)
        return np.where(meters <= FARTHEST_M, meters, np.float32(0.0))

    def color(self, frame: int) -> NDArray[np.uint8]:
        """(H, W, 3), sRGB."""
        stem = self.folder / f"{self.names[frame]}.color"
        path = stem.with_suffix(".color.jpg")
        with Image.open(path if path.exists() else stem.with_suffix(".color.png")) as image:
            return np.asarray(image.convert("RGB"))

    def pose(self, frame: int) -> Floats:
        """(4, 4), camera to world, meters; its rotation made exact."""
        T: Floats = np.loadtxt(self.folder / f"{self.names[frame]}.pose.txt")
        U, _, Vh = np.linalg.svd(T[:3, :3])
        T[:3, :3] = U @ Vh
        return T


def open_recording(folder: Path) -> Recording:
    """The frames in ``folder``. Raises FileNotFoundError."""
    inner = folder / "rgbd-frames"
    frames = inner if inner.is_dir() else folder
    names = tuple(sorted(path.name.removesuffix(".depth.png") for path in frames.glob("*.depth.png")))
    if not names:
        raise FileNotFoundError(f"{folder}: no *.depth.png; see docs/real-data.md for what to put there")
    intrinsics = next((path for name in _INTRINSICS if (path := folder / name).exists()), folder / _INTRINSICS[0])
    return Recording(frames, names, np.loadtxt(intrinsics))


def posed_images(
    recording: Recording, frames: Sequence[int], T_new_world: Sim3, bounds: Floats, stride: int = 1
) -> PosedImages:
    """Frames in a new world frame. bounds: (2, 3), new frame · stride: every so many pixels are kept, both ways."""
    scale = float(T_new_world.scale)
    new = T_new_world.matrix().numpy()
    intrinsics = recording.intrinsics.copy()
    intrinsics[:2, 2] += _PIXEL_CENTER
    intrinsics[:2] /= stride
    # the pixel that is kept is the first of its block: its center moves with it
    intrinsics[:2, 2] += _PIXEL_CENTER * (1.0 - 1.0 / stride)
    poses = new @ np.stack([recording.pose(frame) for frame in frames])
    poses[:, :3, :3] /= scale
    return PosedImages(
        colors=np.stack([recording.color(frame)[::stride, ::stride] for frame in frames]),
        intrinsics=np.broadcast_to(intrinsics, (len(frames), 3, 3)).copy(),
        T_world_camera=poses,
        bounds=np.asarray(bounds, np.float64),
        depths=np.stack([recording.depth(frame)[::stride, ::stride] * np.float32(scale) for frame in frames]),
    )

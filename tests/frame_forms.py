"""Frames and recordings that tests send: small images, their cameras, and forms of them."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SIZE = 12, 16
CAMERA = {"fx": 14.0, "fy": 14.0, "cx": 8.0, "cy": 6.0, "width": 16, "height": 12, "depth_unit": 0.001}


def png(array: Any) -> bytes:
    """A PNG of an array: (H, W) uint16 or bool, or (H, W, 3) uint8."""
    held = io.BytesIO()
    Image.fromarray(array).save(held, "PNG")
    return held.getvalue()


DEPTH = png(np.full(SIZE, 800, np.uint16))
COLOR = png(np.full((*SIZE, 3), 90, np.uint8))
MASK = png(np.indices(SIZE)[1] > 5)


def frame_parts(**changes: Any) -> dict[str, Any]:
    """The parts of a form with one frame, as httpx takes them; None leaves one out."""
    usual = {"depth": DEPTH, "color": COLOR, "camera": json.dumps(CAMERA).encode()} | changes
    return {name: (None if name in ("camera", "name", "request") else name, data)
            for name, data in usual.items() if data is not None}  # fmt: skip


def archive(**files: bytes) -> bytes:
    """An archive of a folder with these files, whose names have _ in place of the dot."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as written:
        for name, data in files.items():
            written.writestr(zipfile.ZipInfo(name.replace("_", ".")), data)
    return held.getvalue()


def stored(path: Path, names: tuple[str, ...] = ("a", "b"), colored: bool = True) -> bytes:
    """The bytes of a stored recording of these frames, each of which sees a slope."""
    from regnf_data.recordings.stored import frame_of_arrays, recording_of_frames, write_recording

    K = [14.0, 14.0, 8.0, 6.0]
    depth = (600 + 20 * np.indices(SIZE)[1]).astype(np.uint16)
    color = np.full((*SIZE, 3), 90, np.uint8) if colored else None
    frames = [frame_of_arrays(depth, K, color, name=name) for name in names]
    write_recording(recording_of_frames(frames), range(len(frames)), path)
    return path.read_bytes()

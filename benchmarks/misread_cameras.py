"""Camera files beside a field, by another convention than the one they are read by."""

from __future__ import annotations

import json
import math
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.misread_files import SOUND, UNITS, Case, Random
from tests.core.importing.twins import Array, Twin

_CAMERAS = 24
_WARNED = "CAMERAS_"


@lru_cache(maxsize=64)
def _field(twin: Twin) -> bytes:
    return SOUND["grid"](twin)


def poses_around(twin: Twin, random: Random) -> Array:
    """(N, 4, 4) camera to world, z forward and y down, around the solid and towards it."""
    low, high = twin.box()
    middle, reach = (low + high) / 2, np.linalg.norm(high - low)
    poses = np.tile(np.eye(4), (_CAMERAS, 1, 1))
    for pose in poses:
        away = random.normal(size=3)
        place = middle + reach * random.uniform(1.0, 1.5) * away / np.linalg.norm(away)
        forward = (middle - place) / np.linalg.norm(middle - place)
        right = np.cross(forward, random.normal(size=3))
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = place
    return poses


def wrong_cameras(reader: str, twin: Twin, random: Random) -> Case:
    poses = poses_around(twin, random)
    gl = poses @ np.diag([1.0, -1.0, -1.0, 1.0])
    body = poses @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    factor = float(random.choice(UNITS) ** random.choice([-1, 1]))
    scaled, mirrored, turned = poses.copy(), poses.copy(), poses.copy()
    scaled[:, :3, 3] *= factor
    mirrored[:, 0, 3] *= -1.0
    turned = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ poses
    line, frame = rf"{_WARNED}|cameras: .*", rf"{_WARNED}|cameras: .*frame and unit"
    made: dict[str, tuple[Any, str]] = {
        "quaternions with w first": (tum(poses, roll=1), line + "quaternions"),
        "world to camera": (tum(np.linalg.inv(poses)), line + "camera to world"),
        "OpenGL's axes": (tum(gl), line + "opencv's axes"),
        "axes of a body": (tum(body), line + "opencv's axes"),
        "poses in another unit": (tum(scaled), frame),
        "x mirrored": (tum(mirrored), frame),
        "another axis up": (tum(turned), frame),
        "decimal comma": (tum(poses).replace(b".", b","), _WARNED),
        "without the time": (b"\n".join(row.partition(b" ")[2] for row in tum(poses).splitlines()), _WARNED),
        "degrees for radians": (transforms(gl, math.degrees(0.9)), _WARNED),
        "OpenCV's axes in transforms.json": (transforms(poses, 0.9), line + "opengl's axes"),
        "transforms.json inverted": (transforms(np.linalg.inv(gl), 0.9), line + "camera to world"),
    }
    error = str(random.choice(list(made)))
    data, said = made[error]
    json_ = data.startswith(b"{")
    options: dict[str, Any] = {"cameras": ("transforms.json" if json_ else "poses.txt", data)}
    if not json_:
        options["description"] = {"cameras": {"intrinsics": [500.0, 500.0, 320.0, 240.0]}}
    return Case(reader, error, _field(twin), said, twin, options | {"harmless": error == "decimal comma"})


def tum(poses: Array, roll: int = 0) -> bytes:
    turns = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), roll, axis=1)
    rows = np.column_stack([np.arange(len(poses)), poses[:, :3, 3], turns])
    return "\n".join(" ".join(f"{value:.6f}" for value in row) for row in rows).encode()


def transforms(poses: Array, angle: float) -> bytes:
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    return json.dumps({"camera_angle_x": angle, "w": 640, "h": 480, "frames": frames}).encode()

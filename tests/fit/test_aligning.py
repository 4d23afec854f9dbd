"""Frames whose stated poses are off by known motions, and what of them geometry can tell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from regnf_core.geometry.box import OrientedBox
from regnf_data.recordings.recording import Frame
from regnf_fit.images.aligning import align_frames
from tests.data.recordings.test_detection import CAMERA, CENTER, RADIUS, TABLE, H, W

REGION = OrientedBox.from_corners(list(CENTER - 0.25), list(CENTER + 0.25))
AWAY = 9.0
WALLS = {"corner": (0.2, 1.1), "ball on a table": (-AWAY, AWAY), "table": (-AWAY, AWAY)}
"""Where there is a wall beside, x, and one behind, z."""


def turned(axis: Any, degrees: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    S = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.asarray(np.eye(3) + np.sin(angle) * S + (1 - np.cos(angle)) * S @ S)


def about(middle: Any, R: Any, shift: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.asarray(middle) + shift - R @ np.asarray(middle)
    return T


def depth_from(T: Any, scene: str, rng: np.random.Generator) -> Any:
    """(H, W) by formulas: a table, its ball but for the table alone, the scene's walls; noise of 1 mm."""
    rows, columns = np.indices((H, W)) + 0.5
    rays = CAMERA.rays(np.stack([columns.ravel(), rows.ravel()], axis=1)) @ T[:3, :3].T
    start, (beside, behind) = T[:3, 3], WALLS[scene]
    with np.errstate(divide="ignore", invalid="ignore"):
        planes = [(value - start[axis]) / rays[:, axis] for axis, value in ((1, TABLE), (0, beside), (2, behind))]
    depth = np.min([np.where(plane > 0.0, plane, np.inf) for plane in planes], axis=0)
    if scene != "table":
        a, b = (rays**2).sum(-1), rays @ (CENTER - start)
        root = b * b - a * ((CENTER - start) @ (CENTER - start) - RADIUS**2)
        depth = np.minimum(depth, np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf))
    depth += 0.001 * rng.normal(size=depth.shape)
    return np.where(depth < 3.0, depth, 0.0).reshape(H, W).astype(np.float32)


@pytest.mark.parametrize("scene", list(WALLS))
@pytest.mark.parametrize(("shift", "degrees"), [(0.0, 0.0), (0.005, 1.0), (0.02, 2.0)])
def test_poses_move_as_far_as_the_geometry_tells(scene: str, shift: float, degrees: float) -> None:
    rng = np.random.default_rng(7)
    true = about(CENTER, turned([0.2, 1.0, 0.1], 20.0), [0.02, -0.03, 0.0])
    off = about(CENTER, turned([0.5, 0.4, -0.6], degrees), shift * np.array([0.6, -0.64, 0.48]))
    frames = [
        Frame("first", depth_from(np.eye(4), scene, rng), CAMERA, np.eye(4)),
        Frame("second", depth_from(true, scene, rng), CAMERA, off @ true),
    ]
    found = align_frames(frames, REGION)
    left = found.frames[1].T_world_camera @ np.linalg.inv(true)
    at_ball = left[:3, :3] @ CENTER + left[:3, 3] - CENTER
    spin, stated_spin = ((T[0, 2] - T[2, 0]) / 2.0 for T in (left, off))
    assert abs(left[1, 0]) + abs(left[1, 2]) < 0.004  # the table is level
    assert abs(at_ball[1]) < 0.001
    if scene == "table":  # along it nothing tells
        assert np.abs(at_ball - off[:3, :3] @ CENTER - off[:3, 3] + CENTER)[[0, 2]].max() < 0.004
    else:
        assert np.abs(at_ball).max() < 0.0015
    assert abs(spin - (0.0 if scene == "corner" else stated_spin)) < 0.005
    assert found.spread < 0.003
    assert bool(found.notes) == (shift > 0.0)
    np.testing.assert_array_equal(found.frames[0].T_world_camera, np.eye(4))

"""Recordings whose files say something wrong: the depth images tell what, and right ones are not accused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from regnf_core.errors import DatasetError
from regnf_data.agreement import check_agreement
from regnf_data.recordings.opening import open_recording
from tests.data.recordings import writers
from tests.data.recordings.truth import HEIGHT, WIDTH, K, Truth, walk

TRUTH = walk(12)
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def lengths() -> Any:
    """(H, W): of rays whose part along the axis is 1."""
    rows, columns = np.indices((HEIGHT, WIDTH)).astype(float)
    return np.sqrt(1.0 + ((columns - K[0, 2]) / K[0, 0]) ** 2 + ((rows - K[1, 2]) / K[1, 1]) ** 2)


def quaternions_rolled(poses: Any) -> Any:
    """Poses whose quaternions were written w first and are read w last."""
    rolled = poses.copy()
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rolled[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix()
    return rolled


def told(truth: Truth, folder: Path, intrinsics: Any = None) -> str | None:
    """What the check says of the recording as 7-Scenes has it."""
    writers.seven_scenes(folder, truth)
    if intrinsics is not None:
        np.savetxt(next(folder.glob("*ntrinsic*")), intrinsics)
    recording = open_recording(folder)
    try:
        return check_agreement(recording.posed_images(range(len(recording)), np.zeros((2, 3))))
    except DatasetError as error:
        return f"{error.reason}: {error} {error.hint}"


WRONG: dict[str, tuple[Any, str]] = {
    "the inverse of the poses": (lambda t: replace(t, poses=np.linalg.inv(t.poses)), "from the world to the camera"),
    "OpenGL's axes": (lambda t: replace(t, poses=t.poses @ FLIP), "OpenGL's axes"),
    "both": (lambda t: replace(t, poses=np.linalg.inv(t.poses @ FLIP)), "from the world to the camera and cameras"),
    "distances along rays": (lambda t: replace(t, depths=t.depths * lengths()), "distances along the rays"),
    "steps of 1/5000": (lambda t: replace(t, depths=5.0 * t.depths), "steps of 1/5000"),
    "poses in millimeters": (
        lambda t: replace(t, poses=np.concatenate([t.poses[:, :3, :3], 1000.0 * t.poses[:, :3, 3:]], axis=2)),
        "poses in millimeters",
    ),
    "quaternions w first": (lambda t: replace(t, poses=quaternions_rolled(t.poses)), "w first"),
    "poses one image off": (lambda t: replace(t, poses=np.roll(t.poses, 1, axis=0)), "poses [-+]1 images off"),
    "poses in reverse": (lambda t: replace(t, poses=t.poses[::-1]), "in reverse order"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_is_named(name: str, tmp_path: Path) -> None:
    change, said = WRONG[name]
    truth = change(TRUTH)
    if truth.poses.shape[1] == 3:
        rows = np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(truth.poses), 1, 1))
        truth = replace(truth, poses=np.concatenate([truth.poses, rows], axis=1))
    assert re.search(said, str(told(truth, tmp_path)))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (np.diag([2.0, 2.0, 1.0]) @ K, "are the intrinsics those of another resolution"),
        (np.diag([0.5, 0.5, 1.0]) @ K, "intrinsics of images 0.5 times as large"),
    ],
)
def test_intrinsics_of_other_images_are_named(wrong: Any, said: str, tmp_path: Path) -> None:
    assert said in str(told(TRUTH, tmp_path, wrong))


@pytest.mark.parametrize("count", [1, 2, 3, 12])
@pytest.mark.parametrize("still", [False, True])
def test_what_is_right_is_not_accused(count: int, still: bool, tmp_path: Path) -> None:
    truth = walk(count)
    if still:
        truth = replace(truth, poses=np.repeat(truth.poses[:1], count, axis=0),
                        depths=np.repeat(truth.depths[:1], count, axis=0))  # fmt: skip
    assert told(truth, tmp_path) is None

"""Conventions that a recording's files state wrongly are named in its layout's words; right ones are not accused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from regnf_core.errors import DatasetError
from regnf_data.agreement import check_agreement
from regnf_data.recordings.images import images_of
from regnf_data.recordings.opening import open_recording
from regnf_data.recordings.recording import Given, check_recording
from regnf_data.recordings.stored import write_recording
from tests.data.recordings import writers
from tests.data.recordings.truth import HEIGHT, WIDTH, Array, K, Truth, walk

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
AT = np.eye(4)[3] * [[1.0], [1.0], [1.0], [0.0]]
"""One where a pose has the camera's place."""


@cache
def truth() -> Truth:
    return walk(12)


def posed(change: Callable[[Array], Array]) -> Truth:
    return replace(truth(), poses=change(truth().poses))


def deep(change: Callable[[Array], Array]) -> Truth:
    return replace(truth(), depths=change(truth().depths))


def lengths() -> Array:
    v, u = np.indices((HEIGHT, WIDTH)).astype(np.float64)
    return np.asarray(np.sqrt(((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2 + 1.0))


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Change a file by a pattern."""

    def change(folder: Path) -> None:
        path = folder / name
        text, count = re.subn(old, new, path.read_text(), flags=re.MULTILINE)
        assert count
        path.write_text(text)

    return change


def half_the_intrinsics(folder: Path) -> None:
    writers.text(folder / "camera-intrinsics.txt", np.diag([0.5, 0.5, 1.0]) @ (K + writers.HALF) - writers.HALF)


def nothing(_: Path) -> None:
    return None


ROW = r"^(1\d\d\.\d+) (\S+ \S+ \S+) (\S+) (\S+) (\S+) (\S+)$"
WRONG: dict[str, tuple[str, Callable[[], Truth], Callable[[Path], None], str]] = {
    "OpenGL's axes": ("7scenes", lambda: posed(lambda T: T @ OPENGL), nothing, "--camera-axes opengl"),
    "OpenCV's axes": ("nerfstudio", lambda: posed(lambda T: T @ OPENGL), nothing, "--camera-axes opencv"),
    "world to camera": ("redwood", lambda: posed(np.linalg.inv), nothing, "Invert.*must map from the camera to"),
    "camera to world": ("bop", lambda: posed(np.linalg.inv), nothing, "cam_R_w2c.*must map from the world to"),
    "inverse and OpenGL": (
        "scannet", lambda: posed(lambda T: np.linalg.inv(T @ OPENGL)), nothing, "pose/.*--camera-axes opengl"),
    "along rays": ("replica", lambda: deep(lambda d: d * lengths()), nothing, "divide each by the length of its ray"),
    "millimeters as 1/5000": ("tum", lambda: deep(lambda d: d / 5.0), nothing, "--depth-unit.*by 5"),
    "another scale": ("colmap", lambda: deep(lambda d: d * 1.7), nothing, "--depth-unit.*by 0.58"),
    "BOP's depth_scale 1": ("bop", truth, edit("scene_camera.json", '"depth_scale": 0.1', '"depth_scale": 1'),
                            "depth_scale.*by 0.1;"),
    "K of half the size": ("7scenes", truth, half_the_intrinsics,
                           "camera-intrinsics.txt in pixels"),
    "poses in millimeters": ("7scenes", lambda: posed(lambda T: T * (1.0 + 999.0 * AT)), nothing,
                             "or divide the poses"),
    "poses in reverse": ("scannet", lambda: posed(lambda T: T[::-1]), nothing, "correct pose in pose/"),
    "w first": ("tum", truth, edit("groundtruth.txt", ROW, r"\1 \2 \6 \3 \4 \5"), "quaternions of groundtruth.txt"),
    "poses one off": (
        "redwood", lambda: posed(lambda T: np.roll(T, 1, axis=0)), nothing, "correct pose in the trajectory"),
    "order of text": (
        "replica", lambda: posed(lambda T: T[[0, 1, 10, 11, 2, 3, 4, 5, 6, 7, 8, 9]]), nothing,
        "correct pose in traj.txt"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_convention_is_named(wrong: str, tmp_path: Path) -> None:
    layout, make, change, mend = WRONG[wrong]
    folder = writers.FOLDERS[layout][0](tmp_path / "recording", make())
    change(folder)
    with pytest.raises(DatasetError, match="contradict each other") as found:
        check_recording(open_recording(folder))
    assert found.value.reason == "DATASET_FRAMES_DISAGREE"
    assert re.search(mend, str(found.value.hint)), found.value.hint
    assert "meta_data" not in str(found.value.hint)


@pytest.mark.parametrize("wrong", ["camera to world", "OpenCV's axes"])
def test_it_is_named_alike_when_it_is_stored_and_when_it_is_fused(wrong: str, tmp_path: Path) -> None:
    layout, make, _, mend = WRONG[wrong]
    recording = open_recording(writers.FOLDERS[layout][0](tmp_path / "recording", make()))
    write_recording(recording, range(12), tmp_path / "stored.safetensors")
    for path in (tmp_path / "recording", tmp_path / "stored.safetensors"):
        with pytest.raises(DatasetError, match="contradict each other") as found:
            check_agreement(images_of(path).images)
        assert re.search(mend, str(found.value.hint)), found.value.hint


@pytest.mark.parametrize(("layout", "axes"), [("7scenes", "opengl"), ("nerfstudio", "opencv")])
def test_what_the_hint_says_mends_it(layout: str, axes: str, tmp_path: Path) -> None:
    folder = writers.FOLDERS[layout][0](tmp_path / "recording", posed(lambda T: T @ OPENGL))
    assert check_recording(open_recording(folder, Given(axes=axes))) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("frames", [[0], [0, 1], [0, 11], [0, 4, 8], [5] * 4, [*range(12)]], ids=str)
def test_right_recordings_are_not_accused(frames: list[int], tmp_path: Path) -> None:
    """One frame, two, ones that share little, a camera that stands still."""
    some = Truth(truth().depths[frames], truth().colors[frames], truth().poses[frames], truth().stamps[: len(frames)])
    for layout in ("7scenes", "bop", "nerfstudio"):
        assert check_recording(open_recording(writers.FOLDERS[layout][0](tmp_path / layout, some))) is None


# Intrinsics of which no file says the resolution.


@pytest.mark.parametrize("of", ["depth", "color"])
def test_intrinsics_are_of_the_images_whose_middle_they_have(of: str, tmp_path: Path) -> None:
    """Color images twice as large as the depth images, and one matrix for both."""
    folder = writers.seven_scenes(tmp_path / "recording", truth())
    for path in folder.glob("*.color.png"):
        writers.png(path, truth().colors[0].repeat(2, axis=0).repeat(2, axis=1))
    if of == "color":
        twice = np.diag([2.0, 2.0, 1.0]) @ (K + writers.HALF) - writers.HALF
        writers.text(folder / "camera-intrinsics.txt", twice)
    frame = open_recording(folder).frames[0].read()
    np.testing.assert_allclose(frame.camera.K, K + writers.HALF)
    assert frame.color_camera is not None
    np.testing.assert_allclose(frame.color_camera.K, np.diag([2.0, 2.0, 1.0]) @ (K + writers.HALF))


def test_intrinsics_of_another_resolution_are_refused_for_one_frame(tmp_path: Path) -> None:
    writers.depth_png(tmp_path / "depth.png", truth().depths[0], 1000.0)
    for values, said in (
        ({"fx": 140, "fy": 144, "cx": 78.5, "cy": 62.5}, "intrinsics are for another resolution"),
        ({"fx": 70, "fy": 72, "cx": 31, "cy": 39, "width": HEIGHT, "height": WIDTH}, "width and height are swapped"),
        ({"K": K.T.tolist()}, "transposed"),
        ({"K": [[70, 0, 39], [0, 72, 31], [0, 0, 0]]}, "not a camera matrix"),
        ({"fx": float("nan"), "fy": 72, "cx": 39, "cy": 31}, "not finite"),
        ({"fx": -70, "fy": 72, "cx": 39, "cy": 31}, "camera matrix"),
        ({"fx": 0.7, "fy": 0.72, "cx": 39, "cy": 31}, "focal lengths"),
    ):
        (tmp_path / "camera.json").write_text(json.dumps(values))
        with pytest.raises(DatasetError, match=said) as found:
            open_recording(tmp_path).frames[0].read()
        assert found.value.reason == "DATASET_INTRINSICS_INVALID"

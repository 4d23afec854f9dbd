"""Where cameras stood, by every format that says it: the same cameras, written in each and read again."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from regnf_core.errors import FieldFormatError
from regnf_core.importing.observing.reading import read_trajectory
from regnf_core.importing.observing.trajectory import Trajectory
from regnf_core.importing.run.opened import SettingsFile
from regnf_core.importing.upload_description import CamerasDescription

WIDTH, HEIGHT = 640, 480
K = np.array([[525.0, 0.0, 319.5], [0.0, 520.0, 239.5], [0.0, 0.0, 1.0]])
SAID = CamerasDescription(intrinsics=[525.0, 520.0, 319.5, 239.5], size=[WIDTH, HEIGHT])
NOTHING = CamerasDescription()


def poses(count: int = 5) -> np.ndarray:
    """(N, 4, 4), camera to world, opencv."""
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, :3] = Rotation.random(count, random_state=0).as_matrix()
    found[:, :3, 3] = np.random.default_rng(1).uniform(-2, 2, (count, 3))
    return found


def opengl(matrices: np.ndarray) -> np.ndarray:
    """By a rotation of the camera's frame, not by signs of columns: half a turn about x."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    return matrices @ turn


def file(name: str, text: str | bytes) -> SettingsFile:
    return SettingsFile(name, memoryview(text.encode() if isinstance(text, str) else text))


def transforms(**more: Any) -> dict[str, Any]:
    said = {"fl_x": 525.0, "fl_y": 520.0, "cx": 319.5, "cy": 239.5, "w": WIDTH, "h": HEIGHT}
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(opengl(poses()))]
    return {"camera_model": "OPENCV", **said, "frames": frames, **more}


def meta_data() -> dict[str, Any]:
    frames = [{"rgb_path": "0.png", "camtoworld": pose.tolist(), "intrinsics": K.tolist()} for pose in poses()]
    return {"camera_model": "OPENCV", "width": WIDTH, "height": HEIGHT, "frames": frames}


def tum() -> str:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for index, pose in enumerate(poses()):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat() * (-1.0) ** index
        lines.append(" ".join(map(repr, [index / 30, *pose[:3, 3].tolist(), *quaternion.tolist()])))
    return "\n".join(lines) + "\n"


def matrices() -> list[SettingsFile]:
    """In another order than that of the numbers in their names."""
    each = [
        file(f"frame-{i}.pose.txt", "\n".join(" ".join(map(repr, row)) for row in pose.tolist()))
        for i, pose in enumerate(poses())
    ]
    return each[::-1]


def neus() -> bytes:
    out = io.BytesIO()
    arrays: dict[str, Any] = {}
    for index, pose in enumerate(poses()):
        inverse = np.linalg.inv(pose)
        arrays[f"world_mat_{index}"] = np.vstack([(-1.0) ** index * 3.0 * K @ inverse[:3], [[0, 0, 0, 1]]])
        arrays[f"scale_mat_{index}"] = np.eye(4)
    np.savez(out, **arrays)
    return out.getvalue()


def assert_same(found: Trajectory) -> None:
    expected = poses()
    points = np.random.default_rng(2).uniform(-1, 1, (20, 3))
    size = np.array([WIDTH, HEIGHT])
    assert len(found) == len(expected)
    cameras = found.pinhole()
    for index, pose in enumerate(expected):
        local = (np.c_[points, np.ones(20)] @ np.linalg.inv(pose).T)[:, :3]
        pixels = local @ K.T
        places, depth = cameras.project(index, torch.from_numpy(points))
        before = local[:, 2] > 0.01
        assert np.allclose(depth.numpy(), local[:, 2], atol=1e-6)
        assert np.allclose(places.numpy()[before] * size, (pixels[:, :2] / pixels[:, 2:])[before], atol=1e-4)


def lines(rows: np.ndarray) -> str:
    return "\n".join(" ".join(map(repr, row)) for row in rows.tolist())


ROWS = [{"transform_matrix": pose[:3].tolist()} for pose in poses()]
SIZE = CamerasDescription(size=[WIDTH, HEIGHT])
READ: dict[str, tuple[list[SettingsFile], CamerasDescription]] = {
    "nerfstudio": ([file("transforms.json", json.dumps(transforms()))], NOTHING),
    "any name": ([file("cameras", json.dumps(transforms()))], NOTHING),
    "axes that are said": (
        [file("transforms.json", json.dumps({**transforms(), "frames": ROWS}))],
        CamerasDescription(axes="opencv"),
    ),
    "sdfstudio without its images": ([file("meta_data.json", json.dumps(meta_data()))], NOTHING),
    "TUM": ([file("groundtruth.txt", tum())], SAID),
    "a folder of poses": (matrices(), SAID),
    "poses and intrinsics": ([*matrices(), file("camera-intrinsics.txt", lines(K))], SIZE),
    "NeuS": ([file("cameras_sphere.npz", neus())], SIZE),
    "a lost camera": ([*matrices(), file("frame-9.pose.txt", "\n".join(["-inf -inf -inf -inf"] * 4))], SAID),
}


def _quaternions(w_first: bool, matrices: np.ndarray) -> np.ndarray:
    return np.roll(Rotation.from_matrix(matrices[:, :3, :3]).as_quat(), int(w_first), axis=1)


def _table(before: np.ndarray, *, w_first: bool = False, behind: int = 0) -> np.ndarray:
    return np.c_[before, poses()[:, :3, 3], _quaternions(w_first, poses()), np.ones((5, behind))]


def _colmap() -> list[SettingsFile]:
    inverse, model = np.linalg.inv(poses()), f"1 PINHOLE {WIDTH} {HEIGHT} 525 520 319.5 239.5\n"
    rows = np.c_[np.arange(5), _quaternions(True, inverse), inverse[:, :3, 3], np.ones(5)].tolist()
    images = "".join(f"{row[0]:.0f} {' '.join(map(repr, row[1:8]))} 1 {row[0]:.0f}.png\n\n" for row in rows)
    return [file("cameras.txt", "# cameras\n" + model), file("images.txt", "# images\n" + images)]


def _open3d() -> str:
    intrinsic = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": K.T.ravel().tolist()}
    each = [{"extrinsic": one.T.ravel().tolist(), "intrinsic": intrinsic} for one in np.linalg.inv(poses())]
    return json.dumps({"class_name": "PinholeCameraTrajectory", "parameters": each})


STAMPS, COUNT = 1.4e18 + 5e6 * np.arange(5.0), np.arange(5.0)
EUROC = "#timestamp [ns], p_x, ...\n" + lines(_table(STAMPS, w_first=True, behind=9)).replace(" ", ",")
STRAY = "timestamp, frame, x, y, z, qx, qy, qz, qw\n" + lines(_table(np.c_[COUNT / 60, COUNT])).replace(" ", ", ")
GRAPH = json.dumps({"class_name": "PoseGraph", "nodes": [{"pose": one.T.ravel().tolist()} for one in poses()]})
LOST = transforms()["frames"] + [{"transform_matrix": [[math.nan] * 4] * 4}, {"transform_matrix": None}]
READ |= {
    "KITTI": ([file("poses.txt", lines(poses()[:, :3].reshape(5, 12)))], SAID),
    "Replica": ([file("traj.txt", lines(poses().reshape(5, 16)))], SAID),
    "Redwood": ([file("a.log", "".join(f"{i} {i} {i + 1}\n{lines(one)}\n" for i, one in enumerate(poses())))], SAID),
    "EuRoC": ([file("data.csv", EUROC)], SAID),
    "Stray Scanner": ([file("odometry.csv", STRAY)], SAID),
    "RTAB-Map": ([file("poses.txt", lines(_table(COUNT / 30, behind=1)))], SAID),
    "COLMAP": (_colmap(), NOTHING),
    "Open3D": ([file("trajectory.json", _open3d())], NOTHING),
    "a pose graph": ([file("pose_graph.json", GRAPH)], SAID),
    "lost cameras": ([file("transforms.json", json.dumps({**transforms(), "frames": LOST}))], NOTHING),
}


@pytest.mark.parametrize("name", READ)
def test_every_format_gives_the_same_cameras(name: str) -> None:
    assert_same(read_trajectory(*READ[name]))


def test_an_angle_in_place_of_pixels() -> None:
    said = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / 525.0), "w": WIDTH, "h": HEIGHT}
    frames = transforms()["frames"]
    found = read_trajectory([file("transforms_train.json", json.dumps({**said, "frames": frames}))], NOTHING)
    assert np.allclose(found.focal, [525.0 / WIDTH, 525.0 / HEIGHT])
    assert np.allclose(found.middle, 0.5)


def test_the_transform_that_nerfstudio_applied_is_told() -> None:
    applied = np.eye(4)
    applied[:3] = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0.5]])
    content = transforms(applied_transform=applied[:3].tolist(), applied_scale=2.0)
    found = read_trajectory([file("transforms.json", json.dumps(content))], NOTHING)
    assert found.T_dataset_file is not None
    point = np.array([0.3, -0.2, 0.9, 1.0])
    moved = applied @ point
    moved[:3] *= 2.0
    assert np.allclose(found.T_dataset_file @ moved, point)


def _with(change: Callable[[dict[str, Any]], Any]) -> list[SettingsFile]:
    content = transforms()
    change(content)
    return [file("transforms.json", json.dumps(content))]


BAD: list[tuple[list[SettingsFile], str]] = [
    ([file("a.json", "{}")], "CAMERAS_NOT_RECOGNIZED"),
    ([file("a.txt", "")], "CAMERAS_NOT_RECOGNIZED"),
    ([file("a.txt", "1 2 3\n")], "CAMERAS_NOT_RECOGNIZED"),
    ([file("a.txt", "1 hello\n")], "CAMERAS_MALFORMED"),
    ([file("a.xml", "<cameras>\n")], "CAMERAS_NOT_RECOGNIZED"),
    ([file("a.txt", b"\xff\xfe\x00")], "CAMERAS_MALFORMED"),
    ([file("transforms.json", '{"frames": [')], "CAMERAS_MALFORMED"),
    ([file("groundtruth.txt", tum())], "CAMERAS_INTRINSICS_MISSING"),
    (_with(lambda c: [c.pop(name) for name in ("fl_x", "fl_y")]), "CAMERAS_INTRINSICS_MISSING"),
    (_with(lambda c: c.update(camera_model="EQUIRECTANGULAR")), "CAMERAS_NOT_SUPPORTED"),
    (_with(lambda c: c.update(fl_x=1e-9)), "CAMERAS_MALFORMED"),
    (_with(lambda c: c.update(w=-5)), "CAMERAS_MALFORMED"),
    (_with(lambda c: c.update(fl_x="525")), "CAMERAS_MALFORMED"),
    (_with(lambda c: c["frames"].append(3)), "CAMERAS_MALFORMED"),
    (_with(lambda c: c["frames"].append({})), "CAMERAS_MALFORMED"),
    (_with(lambda c: c["frames"][2].update(transform_matrix=[[1, 2], [3, 4]])), "CAMERAS_MALFORMED"),
    (_with(lambda c: c["frames"][2]["transform_matrix"][0].__setitem__(3, 1e300)), "CAMERAS_MALFORMED"),
    (
        _with(lambda c: c["frames"][2].update(transform_matrix=np.diag([2.0, 2.0, 2.0, 1.0]).tolist())),
        "CAMERAS_MALFORMED",
    ),
    (
        _with(lambda c: c["frames"][2].update(transform_matrix=np.diag([-1.0, 1.0, 1.0, 1.0]).tolist())),
        "CAMERAS_MALFORMED",
    ),
    (_with(lambda c: c.update(applied_transform=np.zeros((3, 4)).tolist())), "CAMERAS_MALFORMED"),
]


@pytest.mark.parametrize(("files", "reason"), BAD)
def test_what_is_refused(files: list[SettingsFile], reason: str) -> None:
    assert _read_or_refused(files, NOTHING) == reason


@pytest.mark.parametrize(
    "written", ["1" + "0" * 309, "1e309", "-1e309", "1e308", "5e-324", "1" * 17, "null", "true", "[]"]
)
@pytest.mark.parametrize("name", ["transforms.json", "meta_data.json", "groundtruth.txt"])
def test_each_number_in_turn_is_an_extreme_one(name: str, written: str) -> None:
    contents = {"transforms.json": transforms(applied_transform=np.eye(4)[:3].tolist()), "meta_data.json": meta_data()}
    text = json.dumps(contents[name]) if name in contents else tum()
    for number in re.finditer(r"-?[0-9.]+(e-?[0-9]+)?(?=[,\] }\n])", text):
        changed = text[: number.start()] + written + text[number.end() :]
        found = _read_or_refused([file(name, changed)], SAID if name.endswith("txt") else NOTHING)
        if isinstance(found, Trajectory):
            assert np.abs(found.poses[:, :3, :3]).max() < 1.1, number
            assert np.isfinite(np.c_[found.focal, found.middle, found.aspect]).all(), number
        else:
            assert found.startswith("CAMERAS_"), number


def _read_or_refused(files: list[SettingsFile], said: CamerasDescription) -> Trajectory | str:
    """What was read, or the reason why nothing was."""
    try:
        return read_trajectory(files, said)
    except FieldFormatError as error:
        return error.reason


def test_a_quaternion_of_zeros_is_no_pose() -> None:
    assert _read_or_refused([file("a.txt", "0 1 2 3 0 0 0 0\n")], SAID) == "CAMERAS_MALFORMED"

"""Conventions that no file states are told by the images, which contradict each other otherwise."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.worlds.dataset_writer import write_dataset
from benchmarks.worlds.trajectories import look_at
from regnf_core.errors import DatasetError
from regnf_data.agreement import check_agreement
from regnf_data.posed_images import PosedImages
from regnf_data.sdfstudio import load_dataset
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.images.fusion import fuse_images
from tests.fit.images import scenes

Floats = NDArray[np.float64]
SIZE = 60, 80
K = np.array([[60.0, 0.0, 42.0], [0.0, 60.0, 29.0], [0.0, 0.0, 1.0]])
BOXES = np.array(
    [[[-2.2, -1.8, 0.0], [2.2, 1.8, 2.5]], [[-1.0, -0.4, 0.0], [-0.2, 0.4, 0.8]], [[0.6, 0.5, 0.0], [1.2, 1.0, 1.4]]]
)
"""A room and two chests in it."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
BODY = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a robot's body, x forward and z up, to a camera."""


def rays() -> Floats:
    rows, columns = np.indices(SIZE) + 0.5
    return np.asarray(np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T)


@cache
def recording(count: int = 16, noise: float = 0.002) -> PosedImages:
    """A walk along the middle of the room, looking about, with depths by the slabs of the boxes."""
    along = np.linspace(0.0, 1.0, count)
    places = np.stack([3.0 * along - 1.5, -1.2 + 0.4 * np.sin(5.0 * along), 1.2 + 0.3 * along], axis=1)
    poses = look_at(places, np.stack([1.0 - 2.0 * along, np.full(count, 1.0), np.full(count, 0.5)], axis=1))
    directions = np.einsum("nij,hwj->nhwi", poses[:, :3, :3], rays())
    depths = np.full((count, *SIZE), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for number, box in enumerate(BOXES):
            both = (box[:, None, None, None] - places[None, :, None, None]) / directions[None]  # (2, N, H, W, 3)
            near, far = both.min(axis=0).max(axis=-1), both.max(axis=0).min(axis=-1)
            depths = np.minimum(depths, far if number == 0 else np.where((near < far) & (near > 0.0), near, np.inf))
    depths += np.random.default_rng(1).normal(scale=noise, size=depths.shape) * depths**2
    return PosedImages(
        colors=np.full((count, *SIZE, 3), 128, np.uint8),
        intrinsics=np.tile(K, (count, 1, 1)),
        T_world_camera=poses,
        bounds=np.array([[-2.4, -2.0, -0.2], [2.4, 2.0, 2.7]]),
        depths=depths.astype(np.float32),
    )


def with_poses(change: Callable[[Floats], Floats]) -> Callable[[PosedImages], PosedImages]:
    return lambda images: replace(images, T_world_camera=change(images.T_world_camera))


def with_depths(change: Callable[[Floats], Floats]) -> Callable[[PosedImages], PosedImages]:
    return lambda images: replace(images, depths=np.asarray(change(images.depths), np.float32))


def reordered(poses: Floats, order: list[int]) -> Floats:
    """What poses become whose quaternions are read in another order than they were written in."""
    read = poses.copy()
    read[:, :3, :3] = Rotation.from_quat(Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, order]).as_matrix()
    return read


FAR = np.zeros((4, 4))
FAR[:3, 3] = 448_262.0, 5_413_920.0, 112.0
LENGTHS = np.linalg.norm(rays(), axis=-1)
WRONG: dict[str, tuple[Callable[[PosedImages], PosedImages], str]] = {
    "OpenGL": (with_poses(lambda T: T @ OPENGL), "--camera-axes opengl"),
    "inverted": (with_poses(np.linalg.inv), "Invert the matrices"),
    "inverted OpenGL": (with_poses(lambda T: np.linalg.inv(T @ OPENGL)), "Invert the matrices.*--camera-axes opengl"),
    "a robot's body": (with_poses(lambda T: T @ BODY), "the columns of a camera-to-world pose are the camera's right"),
    "along rays": (with_depths(lambda depths: depths * LENGTHS), "divide each by the length of its ray"),
    "millimeters": (with_depths(lambda depths: 1000.0 * depths), "by 0.001"),
    "5000 for 1000": (with_depths(lambda depths: 5.0 * depths), "by 0.2"),
    "feet": (with_depths(lambda depths: depths / 0.3048), "by 0.30"),
    "another scale": (with_depths(lambda depths: 1.7 * depths), "by 0.5"),
    "disparity": (with_depths(lambda depths: 20.0 / depths), "Write depths"),
    "half the size": (lambda images: replace(images, intrinsics=images.intrinsics * [[0.5], [0.5], [1.0]]), "pixels"),
    "turned": (lambda images: replace(images, intrinsics=images.intrinsics[:, [1, 0, 2]][:, :, [1, 0, 2]]), "pixels"),
    "reversed": (with_poses(lambda T: T[::-1]), "each image its correct pose"),
    "one off": (with_poses(lambda T: np.roll(T, 1, axis=0)), "each image its correct pose"),
    "w first": (with_poses(lambda T: reordered(T, [3, 0, 1, 2])), "quaternions of the poses in the expected order"),
    "w last": (with_poses(lambda T: reordered(T, [1, 2, 3, 0])), "quaternions of the poses in the expected order"),
    "mirrored": (with_depths(lambda depths: depths[:, :, ::-1]), "Mirror the depth images"),
    "far from the origin": (with_poses(lambda T: T @ OPENGL + FAR), "opengl"),
}  # fmt: skip


@pytest.mark.parametrize("name", list(WRONG))
def test_the_convention_that_the_images_agree_by_is_named(name: str) -> None:
    change, mend = WRONG[name]
    with pytest.raises(DatasetError, match="contradict each other") as caught:
        check_agreement(change(recording()))
    assert caught.value.reason == "DATASET_FRAMES_DISAGREE"
    assert caught.value.hint is not None
    assert re.search(mend, caught.value.hint), caught.value.hint


@pytest.mark.parametrize(("count", "noise"), [(2, 0.006), (3, 0.0), (16, 0.006)])
def test_good_recordings_pass(count: int, noise: float) -> None:
    assert check_agreement(recording(count, noise)) is None


def test_one_image_a_flat_wall_and_images_that_share_nothing_tell_nothing() -> None:
    one = recording()
    assert one.depths is not None
    single = replace(one, depths=one.depths[:1], T_world_camera=np.linalg.inv(one.T_world_camera[:1]),
                     intrinsics=one.intrinsics[:1], colors=one.colors[:1])  # fmt: skip
    assert check_agreement(single) is None
    for count, apart in ((6, 0.1), (2, 6.0)):
        wall = np.tile(np.eye(4), (count, 1, 1))
        wall[:, 0, 3] = np.arange(count) * apart
        flat = replace(one, depths=np.full((count, *SIZE), 2.0, np.float32), T_world_camera=wall,
                       intrinsics=one.intrinsics[:count], colors=one.colors[:count])  # fmt: skip
        assert check_agreement(flat) is None


def test_poses_of_nowhere_are_warned_of() -> None:
    images = recording()
    rng = np.random.default_rng(0)
    places, targets = (rng.uniform((-2.0, -1.5, 0.3), (2.0, 1.5, 2.2), (16, 3)) for _ in range(2))
    poses = look_at(places, targets)
    warning = check_agreement(replace(images, T_world_camera=poses))
    assert warning is not None
    assert warning.startswith("FRAMES_DISAGREE: of ")


def test_fusing_refuses_and_the_reader_mends(tmp_path: Path) -> None:
    images = replace(recording(), T_world_camera=recording().T_world_camera @ OPENGL)
    with pytest.raises(DatasetError, match="OpenGL"):
        fuse_images(images, tmp_path / "map.safetensors")
    folder = tmp_path / "images"
    write_dataset(images, folder)
    np.testing.assert_allclose(load_dataset(folder, opengl=True).T_world_camera, recording().T_world_camera, atol=1e-6)


# What is refused before a fit or a fusion, and what the refusal says.


def within(images: PosedImages | None = None) -> PosedImages:
    """The images with bounds that the cameras stand in, and without masks: many pixels show nothing."""
    return replace(images or scenes.images(), bounds=np.array([[-3.0] * 3, [3.0] * 3]), masks=None)


def scaled(factor: float, poses: float = 1.0) -> PosedImages:
    """Depths and poses of another unit than the bounds."""
    images = within()
    assert images.depths is not None
    T = images.T_world_camera.copy()
    T[:, :3, 3] *= poses
    return replace(images, depths=(factor * images.depths).astype(np.float32), T_world_camera=T)


def fit(images: PosedImages, path: Path) -> object:
    return reconstruct(images, FitFiles(path))


@pytest.mark.parametrize(
    ("make", "factor", "poses", "said"),
    [
        (fit, 1000.0, 1.0, "depths in millimeters? Divided by 1000, 100 %"),
        (fuse_images, 1000.0, 1000.0, "depths and poses in millimeters? Divided by 1000"),
        (fuse_images, 1.0, 1000.0, "poses in millimeters? Divided by 1000"),
        (fuse_images, 100.0, 1.0, "depths in centimeters? Divided by 100"),
        (fuse_images, 5000.0, 1.0, "depths in steps of 1/5000? Divided by 5000"),
    ],
)
def test_another_unit_is_named(
    make: Callable[..., object], factor: float, poses: float, said: str, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match="median") as caught:
        make(scaled(factor, poses), tmp_path / "map.safetensors")
    assert caught.value.reason == "DATASET_NOTHING_IN_BOUNDS"
    assert said in str(caught.value.hint)
    assert "bounds, (-3, -3, -3) to (3, 3, 3);" in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_bounds_that_were_not_given_are_said(tmp_path: Path) -> None:
    images = scenes.images()
    far = images.T_world_camera.copy()
    far[:, :3, 3] += (5.0, 0.0, 0.0)
    cube = np.array([[-1.0] * 3, [1.0] * 3])
    with pytest.raises(DatasetError, match=r"where meta_data.json has no scene_box.*end within \(4") as caught:
        fuse_images(replace(images, T_world_camera=far, bounds=cube), tmp_path / "map.safetensors")
    assert '"scene_box": {"aabb": [[4' in str(caught.value.hint)


def test_masks_that_leave_nothing(tmp_path: Path) -> None:
    images = scenes.images()
    with pytest.raises(DatasetError, match="only 0 pixels") as caught:
        fuse_images(replace(images, masks=np.zeros(images.colors.shape[:3], bool)), tmp_path / "map.safetensors")
    assert "whether these are inverted" in str(caught.value.hint)


def test_an_empty_image_among_good_ones_is_passed_over(tmp_path: Path) -> None:
    images = within()
    assert images.depths is not None
    depths = images.depths.copy()
    depths[3] = 0.0
    assert fuse_images(replace(images, depths=depths), tmp_path / "map.safetensors").depth_error_median < 0.01

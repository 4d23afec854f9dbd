"""Folders in the sdfstudio data format: what is written is read again, and other people's folders are read too."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.worlds.dataset_writer import write_dataset
from regnf_core.errors import DatasetError
from regnf_core.geometry.box import OrientedBox
from regnf_data.posed_images import PosedImages
from regnf_data.sdfstudio import METADATA, load_dataset
from tests.data.small import two_images

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_dataset(two_images(), tmp_path / "data")
    return tmp_path / "data"


def change(folder: Path, mend: Change) -> None:
    metadata = json.loads((folder / METADATA).read_text())
    mend(metadata)
    (folder / METADATA).write_text(json.dumps(metadata))


def assert_same(read: PosedImages, written: PosedImages) -> None:
    for name in ("colors", "intrinsics", "T_world_camera", "bounds", "depths", "masks", "T_metric_world"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), err_msg=name)
        if getattr(written, name) is not None:
            assert getattr(read, name).dtype == getattr(written, name).dtype, name
    assert len(read.instances) == len(written.instances)
    for one, other in zip(read.instances, written.instances, strict=True):
        assert one.label == other.label == one.box.label
        for name in ("center", "size", "rotation"):
            np.testing.assert_array_equal(getattr(one.box, name), getattr(other.box, name))
        for name in ("T_object_world", "world_pose", "gt_pose"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_everything_comes_back_exactly(folder: Path) -> None:
    assert_same(load_dataset(folder), two_images())


def test_what_is_absent_comes_back_absent(tmp_path: Path) -> None:
    bare = replace(two_images(), depths=None, masks=None, instances=(), T_metric_world=None)
    (tmp_path / "data").mkdir()  # empty: taken
    write_dataset(bare, tmp_path / "data")
    assert_same(load_dataset(tmp_path / "data"), bare)


def test_a_folder_in_use_is_refused_and_left_alone(folder: Path) -> None:
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises(DatasetError) as refused:
        write_dataset(two_images(), folder)
    assert refused.value.reason == "DATASET_FOLDER_NOT_EMPTY"
    assert sorted(path.name for path in folder.iterdir()) == before
    assert [path.name for path in folder.parent.iterdir()] == ["data"]


def test_a_write_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "no space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(OSError, match="no space"):
        write_dataset(two_images(), tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


def test_the_least_that_a_dataset_may_say(folder: Path) -> None:
    def spare(metadata: dict[str, Any]) -> None:
        for frame in metadata["frames"]:
            del frame["sensor_depth_path"], frame["foreground_mask"]
        metadata["frames"][1].pop("intrinsics")
        metadata["intrinsics"] = metadata["frames"][0].pop("intrinsics")
        metadata["frames"][0]["camtoworld"].pop()
        frames = metadata.pop("frames")
        intrinsics = metadata["intrinsics"]
        metadata.clear()
        metadata.update(frames=frames, intrinsics=intrinsics)

    change(folder, spare)
    read = load_dataset(folder)
    written = two_images()
    assert read.size == (4, 6)
    assert read.depths is read.masks is read.T_metric_world is None
    assert read.instances == ()
    np.testing.assert_array_equal(read.bounds, [[-1, -1, -1], [1, 1, 1]])
    np.testing.assert_array_equal(read.intrinsics, written.intrinsics)
    np.testing.assert_array_equal(read.T_world_camera, written.T_world_camera)


def test_a_frame_without_depth_or_mask(folder: Path) -> None:
    def spare(metadata: dict[str, Any]) -> None:
        del metadata["frames"][1]["sensor_depth_path"], metadata["frames"][0]["foreground_mask"]

    masks = two_images().masks
    assert masks is not None
    Image.fromarray(masks[1].astype(np.uint8)).save(folder / "000001_mask.png")  # of zeros and ones
    change(folder, spare)
    read = load_dataset(folder)
    assert read.depths is not None
    assert read.masks is not None
    np.testing.assert_array_equal(read.depths[0], two_images().depths[0])  # type: ignore[index]
    assert (read.depths[1] == 0.0).all()
    assert read.masks[0].all()
    np.testing.assert_array_equal(read.masks[1], masks[1])


def test_depth_as_a_16_bit_image(folder: Path) -> None:
    millimeters = np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000
    Image.fromarray(millimeters).save(folder / "depth.png")

    def use(metadata: dict[str, Any]) -> None:
        metadata["depth_unit_scale_factor"] = 0.0005
        for frame in metadata["frames"]:
            frame["sensor_depth_path"] = "depth.png"

    change(folder, use)
    read = load_dataset(folder)
    assert read.depths is not None
    np.testing.assert_allclose(read.depths[1], np.arange(24).reshape(4, 6) * 0.5, rtol=1e-7)


def test_depths_that_are_none(folder: Path) -> None:
    depth = np.full((4, 6, 1), 2.0)
    depth[0, :4, 0] = np.nan, np.inf, -1.0, 1e300
    np.save(folder / "000000_depth.npy", depth)
    read = load_dataset(folder)
    assert read.depths is not None
    np.testing.assert_array_equal(read.depths[0, 0], [0, 0, 0, 0, 2, 2])


def test_instances_as_other_files_tell_them(folder: Path) -> None:
    chair = two_images().instances[0].box
    corners = chair.corners()[[3, 7, 0, 6, 1, 5, 2, 4]]

    def use(metadata: dict[str, Any]) -> None:
        del metadata["worldtogt"]
        metadata["instances"] = {
            "c": {"box_corners": corners.tolist(), "worldtogt": np.diag([3.0, 3.0, 3.0, 1.0]).tolist()},
            "7": {"name": "e\nt", "box_min": [0, 0, 0], "box_max": [1, 2, 3]},
            "t": {"box_corners": OrientedBox.from_corners([0, 0, 0], [1, 2, 3]).corners().tolist()},
        }

    change(folder, use)
    read = load_dataset(folder)
    assert [instance.label for instance in read.instances] == ["c", "e?t", "t"]
    for point in corners:  # the same box, whatever its axes are called
        assert (read.instances[0].box.corners() - point).norm(dim=1).min() < 1e-12
    for instance in read.instances[1:]:
        np.testing.assert_array_equal(instance.box.size, [1, 2, 3])
        np.testing.assert_array_equal(instance.box.rotation, np.eye(3))
    np.testing.assert_array_equal(read.T_metric_world, np.diag([3.0, 3.0, 3.0, 1.0]))


def set_frame(**values: Any) -> Change:
    return lambda metadata: metadata["frames"][1].update(values)


def set_top(**values: Any) -> Change:
    return lambda metadata: metadata.update(values)


SHEARED = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
CUBE_BUT_ONE = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0], [1, 1, 5]]


REFUSED: dict[str, list[Change]] = {
    "DATASET_CAMERA_UNSUPPORTED": [
        set_top(camera_model="OPENCV_FISHEYE"), set_top(k1=0.1),
    ],
    "DATASET_NO_FRAMES": [
        set_top(frames=[]), lambda metadata: metadata.pop("frames"),
    ],
    "DATASET_METADATA_INVALID": [
        set_top(frames=[7]), set_top(height="tall"), set_top(height=float("inf")), set_top(width=-6),
        set_top(scene_box=[1]), set_top(scene_box={"aabb": [[1, 1, 1], [0, 0, 0]]}),
        set_top(scene_box={"aabb": [[1, 1], [2, 2]]}), set_top(worldtogt=SHEARED), set_frame(camtoworld=None),
        set_frame(rgb_path="x" * 5000), set_frame(rgb_path=7), set_frame(rgb_path="\ud800"),
        set_frame(rgb_path="a\0b"),
    ],
    "DATASET_SIZES_DIFFER": [
        set_top(height=5), set_frame(rgb_path="large.png"), set_frame(sensor_depth_path="flat.npy"),
        set_frame(foreground_mask="large.png"),
    ],
    "DATASET_TOO_LARGE": [
        set_top(width=10**9, height=10**9),
    ],
    "DATASET_INSTANCE_INVALID": [
        set_top(instances="chair"), set_top(instances=["chair"]), set_top(instances=[{"label": "chair"}]),
        set_top(instances=[{"box_min": [0, 0, 0], "box_max": [1, 1, 0]}]),
        set_top(instances=[{"box_corners": CUBE_BUT_ONE}]),
        set_top(instances=[{"box_min": [0, 0, 0], "box_max": [1, 1, 1], "T_object_world": SHEARED}]),
    ],
    "DATASET_POSE_NOT_RIGID": [
        set_frame(camtoworld=SHEARED), set_frame(camtoworld=MIRRORED),
        set_frame(camtoworld=np.diag([2.0, 2.0, 2.0, 1.0]).tolist()),
        set_frame(camtoworld=np.diag([1e200, 1.0, 1.0, 1.0]).tolist()),
    ],
    "DATASET_INTRINSICS_INVALID": [
        set_frame(intrinsics=None), set_frame(intrinsics=np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()),
        set_frame(intrinsics={"fx": 1}),
    ],
    "DATASET_IMAGE_MISSING": [
        set_frame(rgb_path="absent.png"), set_frame(rgb_path="."), set_frame(foreground_mask="absent.png"),
    ],
    "DATASET_PATH_OUTSIDE": [
        set_frame(rgb_path="../secret.png"), set_frame(rgb_path="/etc/hostname"), set_frame(rgb_path="link.png"),
    ],
    "DATASET_IMAGE_INVALID": [
        set_frame(rgb_path="000000_depth.npy"), set_frame(rgb_path="cut.png"),
        set_frame(sensor_depth_path="pickle.npy"), set_frame(sensor_depth_path="header.npy"),
        set_frame(sensor_depth_path="text.npy"),
    ],
    "DATASET_DEPTH_UNIT_MISSING": [
        set_frame(sensor_depth_path="000000_rgb.png"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(("mend", "reason"), [(mend, reason) for reason, mends in REFUSED.items() for mend in mends])
def test_refused(mend: Change, reason: str, folder: Path) -> None:
    Image.new("RGB", (40, 30)).save(folder / "large.png")
    Image.new("RGB", (6, 4)).save(folder.parent / "secret.png")
    (folder / "link.png").symlink_to(folder.parent / "secret.png")
    (folder / "cut.png").write_bytes((folder / "000000_rgb.png").read_bytes()[:60])
    np.save(folder / "pickle.npy", np.array([{}]), allow_pickle=True)
    (folder / "header.npy").write_bytes((folder / "000000_depth.npy").read_bytes().replace(b"(4, 6)", b"\xb74, 6)"))
    np.save(folder / "text.npy", np.full((4, 6), "x"))
    np.save(folder / "flat.npy", np.zeros(24))
    change(folder, mend)
    with pytest.raises(DatasetError) as refused:
        load_dataset(folder)
    assert refused.value.reason == reason, refused.value


LOST = [[float("nan")] * 4] * 4


def test_frames_of_lost_cameras_are_left_out(folder: Path) -> None:
    whole = load_dataset(folder)
    change(folder, set_frame(camtoworld=LOST))
    rest = load_dataset(folder)
    assert len(rest) == len(whole) - 1
    np.testing.assert_array_equal(rest.T_world_camera, np.delete(whole.T_world_camera, 1, axis=0))
    change(folder, lambda metadata: [frame.update(camtoworld=LOST) for frame in metadata["frames"]])
    with pytest.raises(DatasetError) as refused:
        load_dataset(folder)
    assert refused.value.reason == "DATASET_POSE_NOT_RIGID"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "DATASET_NO_METADATA"),
        (b"", "DATASET_METADATA_INVALID"),
        (b"[]", "DATASET_METADATA_INVALID"),
        (b"\xff\xfe{}", "DATASET_METADATA_INVALID"),
        (b"[" * 100_000, "DATASET_METADATA_INVALID"),
        (b"{}", "DATASET_NO_FRAMES"),
    ],
)
def test_refused_metadata(content: bytes | None, reason: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / METADATA).write_bytes(content)
    with pytest.raises(DatasetError) as refused:
        load_dataset(tmp_path)
    assert refused.value.reason == reason


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_the_largest_number_of_a_type_is_no_depth(folder: Path, kind: type[np.unsignedinteger]) -> None:  # type: ignore[type-arg]
    steps = np.full((4, 6), 100, kind)
    steps[0, 0], steps[0, 1] = np.iinfo(kind).max, 0
    Image.fromarray(steps).save(folder / "depth.png")
    np.save(folder / "000001_depth.npy", np.where(steps == 0, 65504.0, 0.1).astype(np.float16))

    def use(metadata: dict[str, Any]) -> None:
        metadata["depth_unit_scale_factor"] = 0.001
        metadata["frames"][0]["sensor_depth_path"] = "depth.png"

    change(folder, use)
    read = load_dataset(folder)
    assert read.depths is not None
    np.testing.assert_allclose(read.depths[0, 0], [0.0, 0.0, 0.1, 0.1, 0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose(read.depths[1, 0], [0.1, 0.0, 0.1, 0.1, 0.1, 0.1], rtol=1e-3)


def test_a_mask_or_a_colored_picture_is_no_depth(folder: Path) -> None:
    for mode, said in (("1", "one bit per pixel"), ("P", "a palette of colors")):
        Image.fromarray(np.eye(4, 6, dtype=np.uint8) * 255).convert(mode).save(folder / "depth.png")

        def use(metadata: dict[str, Any]) -> None:
            metadata["depth_unit_scale_factor"] = 0.001
            metadata["frames"][0]["sensor_depth_path"] = "depth.png"

        change(folder, use)
        with pytest.raises(DatasetError, match=said):
            load_dataset(folder)

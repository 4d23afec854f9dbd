"""Recordings as apps, trainers and disks leave them: read, or refused with the file's name and a stable reason."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from regnf_core.errors import RegnfError
from regnf_data.recordings.choosing import choose_frames
from regnf_data.recordings.opening import open_recording
from tests.data.recordings import writers
from tests.data.recordings.truth import HEIGHT, WIDTH, K, walk

TRUTH = walk(3)
Change = Callable[[Path], Any]


def put(path: Path, image: Any) -> None:
    Image.fromarray(image).save(path)


def all_of(pattern: str, change: Change) -> Change:
    return lambda folder: [change(path) for path in sorted(folder.rglob(pattern))]


def first_of(pattern: str, change: Change) -> Change:
    return lambda folder: change(sorted(folder.rglob(pattern))[0])


def pose(change: Callable[[Any], Any]) -> Change:
    return all_of("*.pose.txt", lambda path: np.savetxt(path, change(np.loadtxt(path))))


def intrinsics(matrix: Any) -> Change:
    return first_of("*ntrinsic*", lambda path: np.savetxt(path, matrix))


def document(change: Callable[[Any], Any]) -> Change:
    def write(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return all_of("*.json", write)


def trajectory(lines: Callable[[], list[str]]) -> Change:
    def write(folder: Path) -> None:
        (folder / "groundtruth.txt").unlink()
        (folder / "poses.txt").write_text("\n".join(lines()))

    return write


def lines_of_kitti() -> list[str]:
    return [" ".join(map(str, one[:3].ravel())) for one in TRUTH.poses]


def lines_of_euroc(epoch: float = 1.4e9) -> list[str]:
    turns = Rotation.from_matrix(TRUTH.poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    rows = zip(TRUTH.stamps, TRUTH.poses[:, :3, 3], turns, strict=True)
    return ["#timestamp, p_RS_R_x [m], ..."] + [
        ",".join(map(str, (int(1e9 * (epoch + stamp)), *place, *turn, 0.0, 0.0))) for stamp, place, turn in rows
    ]


def later(folder: Path) -> None:
    """TUM's lists with stamps of an epoch."""
    for name in ("depth.txt", "rgb.txt"):
        rows = [row.split() for row in (folder / name).read_text().splitlines() if not row.startswith("#")]
        (folder / name).write_text("\n".join(f"{1.4e9 + float(row[0]):.6f} {row[1]}" for row in rows))


def as_npz(path: Path) -> None:
    path.unlink()
    np.savez(path.with_suffix(".npz"), a=np.ones((HEIGHT, WIDTH)), b=np.ones((HEIGHT, WIDTH)))


def spread_over_16_bits(path: Path) -> Any:
    return (np.asarray(Image.open(path)) // 20 % 256 * 257).astype(np.uint16)


DEPTHS, SCENES = "*.depth.png", "seven_scenes"
REFUSED: dict[str, tuple[str, Change, str, str]] = {
    "zeros": (SCENES, all_of(DEPTHS, lambda p: put(p, np.zeros((HEIGHT, WIDTH), np.uint16))), "DEPTH_MISSING", "depth"),
    "65535": (SCENES, all_of(DEPTHS, lambda p: put(p, np.full((9, 9), 65535, np.uint16))), "INTRINSICS_INVALID", "-0"),
    "8 bits": (SCENES, all_of(DEPTHS, lambda p: put(p, np.full((HEIGHT, WIDTH), 9, np.uint8))), "IMAGE_INVALID",
               "8 bit"),
    "palette": (SCENES, all_of(DEPTHS, lambda p: Image.new("P", (WIDTH, HEIGHT)).save(p)), "IMAGE_INVALID", "palette"),
    "shares": (SCENES, intrinsics(np.diag([1 / WIDTH, 1 / HEIGHT, 1.0]) @ K), "INTRINSICS_INVALID", "by its width"),
    "no focal length": (SCENES, intrinsics(np.diag([0.0, 1.0, 1.0]) @ K), "INTRINSICS_INVALID", "focal lengths 0, 72"),
    "PIZ": ("record3d", first_of("*.exr", lambda p: writers.exr(p, TRUTH.depths[0], 4)), "IMAGE_INVALID", "with ZIP"),
    "cut EXR": ("record3d", first_of("*.exr", lambda p: p.write_bytes(p.read_bytes()[:900])), "IMAGE_INVALID", "0.exr"),
    "Record3D's own": ("record3d", all_of("*.exr", lambda p: p.rename(p.with_suffix(".depth"))), "NO_FRAMES", "depth"),
    "no poses": ("redwood", first_of("*.log", Path.unlink), "NOT_RECOGNIZED", "no poses were found for its 3 depth"),
    "only JPEG": ("redwood", all_of("depth/*", lambda p: p.rename(p.with_suffix(".jpg"))), "SIZES_DIFFER",
                  "3 poses, depth 0 images"),
    "which array": (SCENES, first_of(DEPTHS, as_npz), "IMAGE_INVALID", "which array is the depth"),
    "8 of 16": (SCENES, all_of(DEPTHS, lambda p: put(p, np.full((HEIGHT, WIDTH), 200, np.uint16))), "IMAGE_INVALID",
                "up to 200"),
    "8 spread over 16": (SCENES, all_of(DEPTHS, lambda p: put(p, spread_over_16_bits(p))), "IMAGE_INVALID",
                         "multiples of 257"),
    "colors": (SCENES, all_of(DEPTHS, lambda p: put(p, np.ones((HEIGHT, WIDTH, 3), np.uint8))), "IMAGE_INVALID",
               "frame-000000.depth.png has more than one channel"),
    "empty": (SCENES, first_of(DEPTHS, lambda p: p.write_bytes(b"")), "IMAGE_INVALID", "frame-000000.depth.png"),
    "cut": (SCENES, first_of(DEPTHS, lambda p: p.write_bytes(p.read_bytes()[:200])), "IMAGE_INVALID", "truncated"),
    "bomb": (SCENES, first_of(DEPTHS, lambda p: Image.new("L", (20000, 20000)).save(p)), "IMAGE_INVALID", "400000000"),
    "scaled": (SCENES, pose(lambda T: np.diag([1.3, 1.3, 1.3, 1.0]) @ T), "POSE_NOT_RIGID", "the length 1.3"),
    "mirrored": (SCENES, pose(lambda T: T @ np.diag([1.0, 1.0, -1.0, 1.0])), "POSE_NOT_RIGID", "is a reflection"),
    "transposed pose": (SCENES, pose(np.transpose), "POSE_NOT_RIGID", "frame-000000: the pose is transposed"),
    "lost": (SCENES, pose(lambda T: np.full_like(T, -np.inf)), "NO_FRAMES", "no frame has depth and a pose"),
    "words": (SCENES, first_of("*.pose.txt", lambda p: p.write_text("a b c d")), "METADATA_INVALID", "is not a number"),
    "transposed K": (SCENES, intrinsics(K.T), "INTRINSICS_INVALID", "transposed"),
    "K of NaN": (SCENES, intrinsics(K * np.nan), "INTRINSICS_INVALID", "not finite"),
    "K of larger images": (SCENES, intrinsics(np.diag([3.0, 3.0, 1.0]) @ K), "INTRINSICS_INVALID",
                           "another resolution"),
    "other stamps": ("tum", later, "NO_FRAMES", "no image has a pose"),
    "fewer poses": ("replica", first_of("traj.txt", lambda p: p.write_text(p.read_text().splitlines()[0])),
                    "SIZES_DIFFER", "1 poses, results 3 depth images"),
    "no JSON": ("nerfstudio", first_of("transforms.json", lambda p: p.write_text("{")), "METADATA_INVALID", "JSON"),
    "a list": ("bop", first_of("scene_camera.json", lambda p: p.write_text("[]")),
               "METADATA_INVALID", "is not a JSON object"),
    "no depth": ("nerfstudio", document(lambda d: [one.pop("depth_file_path") for one in d["frames"]]),
                 "DEPTH_MISSING", "has no depth images"),
    "a lens that folds": ("nerfstudio", document(lambda d: d.update(k1=-3.5)), "CAMERA_UNSUPPORTED", "lens"),
    "a path outside": ("nerfstudio", document(lambda d: d["frames"][0].update(depth_file_path="../../x.png")),
                       "PATH_OUTSIDE", "leaves the dataset's folder"),
    "a bag cut short": ("bag", first_of("*.mcap", lambda p: p.write_bytes(p.read_bytes()[:1500])), "BAG_INVALID", ""),
    "an empty bag": ("bag", first_of("*.mcap", lambda p: p.write_bytes(b"")), "BAG_INVALID", "empty"),
    "noise": ("bag", first_of("*.mcap", lambda p: p.write_bytes(os.urandom(500))), "BAG_INVALID", "magic"),
}  # fmt: skip


def read_all(folder: Path) -> None:
    recording = open_recording(folder)
    recording.posed_images(range(len(recording)), np.zeros((2, 3)))
    choose_frames(recording)


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_is_refused_by_name(name: str, tmp_path: Path) -> None:
    layout, change, reason, said = REFUSED[name]
    folder = tmp_path / "recording"
    getattr(writers, layout)(folder, TRUTH)
    change(folder)
    with pytest.raises(RegnfError) as refused:
        read_all(folder)
    assert refused.value.reason == f"DATASET_{reason}"
    assert said in str(refused.value)


def as_float_tiff(path: Path) -> None:
    """Meters, as numbers with a point."""
    put(path.with_suffix(".tiff"), (np.asarray(Image.open(path)) / 1000.0).astype(np.float32))
    path.unlink()


def as_array(ending: str, factor: float) -> Change:
    def write(path: Path) -> None:
        depth = np.asarray(Image.open(path)).astype(np.float64) * factor
        path.unlink()
        depth[0, :2] = np.nan, 1e10  # as renderers write for nothing
        target = path.with_suffix(ending)
        np.savez(target, depth=depth, labels=depth) if ending == ".npz" else np.save(target, depth)

    return all_of(DEPTHS, write)


def listed(name: str, lines: Callable[[], list[str]]) -> Change:
    """A list of poses in place of Redwood's trajectory."""

    def write(folder: Path) -> None:
        (folder / "trajectory.log").unlink()
        (folder / name).write_text("\n".join(lines()))

    return write


def lines_of_stray() -> list[str]:
    turns = Rotation.from_matrix(TRUTH.poses[:, :3, :3]).as_quat()
    rows = zip(TRUTH.poses[:, :3, 3], turns, strict=True)
    named = (f"{0.1 * i}, {i:06d}, " + ", ".join(map(str, (*place, *turn))) for i, (place, turn) in enumerate(rows))
    return ["timestamp, frame, x, y, z, qx, qy, qz, qw", *named]


def in_a_folder(folder: Path) -> None:
    (folder / "trajectory.log").unlink()
    (folder / "poses").mkdir()
    for i, one in enumerate(TRUTH.poses, 1):
        np.save(folder / "poses" / f"{i:06d}.npy", one)


def associated(folder: Path) -> None:
    """One list of pairs in place of two lists."""
    lists = [(folder / f"{name}.txt") for name in ("rgb", "depth")]
    rows = [[row for row in one.read_text().splitlines() if not row.startswith("#")] for one in lists]
    (folder / "associations.txt").write_text("\n".join(map(" ".join, zip(*rows, strict=True))))
    for one in lists:
        one.unlink()


READ: dict[str, tuple[str, Change, int]] = {
    "pairs of images": ("tum", associated, 3),
    "Windows's paths in a list": ("tum", all_of("*.txt", lambda p: p.write_text(p.read_text().replace("/", "\\"))), 3),
    "Windows's paths": (
        "nerfstudio",
        document(
            lambda d: [one.update(depth_file_path=one["depth_file_path"].replace("/", "\\")) for one in d["frames"]]
        ),
        3,
    ),
    "capitals": (SCENES, all_of("*.png", lambda p: p.rename(p.with_suffix(".PNG"))), 3),
    "a matrix in one line": (SCENES, pose(lambda m: m.reshape(1, 16)), 3),
    "a matrix in brackets": (
        SCENES,
        all_of("*.pose.txt", lambda p: p.write_text(str(np.loadtxt(p).tolist()).replace("], ", "],\n"))),
        3,
    ),
    "a text beside the poses": ("scannet", lambda f: (f / "pose" / "readme.txt").write_text("hello"), 3),
    "millimeters with a point": (SCENES, as_array(".npy", 1.0), 3),
    "arrays by name": (SCENES, as_array(".npz", 0.001), 3),
    "Stray Scanner": ("redwood", listed("odometry.csv", lines_of_stray), 3),
    "a matrix a line": ("redwood", listed("poses.txt", lines_of_kitti), 3),
    "four lines a matrix": (
        "redwood",
        listed("traj.txt", lambda: [" ".join(map(str, row)) for one in TRUTH.poses for row in one]),
        3,
    ),
    "an array of poses": (
        "redwood",
        lambda f: ((f / "trajectory.log").unlink(), np.save(f / "poses.npy", TRUTH.poses)),
        3,
    ),
    "a folder of poses": ("redwood", in_a_folder, 3),
    "what the columns are": (
        "tum",
        all_of("groundtruth.txt", lambda p: p.write_text(p.read_text().replace("# timestamp", "timestamp"))),
        3,
    ),
    "files of macOS": (SCENES, all_of("*.p*", lambda p: (p.parent / f"._{p.name}").write_bytes(b"\0\5\x16\7")), 3),
    "instant-ngp": (
        "nerfstudio",
        document(lambda d: d.update(integer_depth_scale=d.pop("depth_unit_scale_factor", 0.001))),
        3,
    ),
    "meters": (SCENES, all_of(DEPTHS, as_float_tiff), 3),
    "zeros of a lost tracker": (
        "tum",
        first_of(
            "groundtruth.txt",
            lambda p: p.write_text(
                re.sub(r"^(100\.0\d* \S+ \S+ \S+) .*$", r"\1 0 0 0 0", p.read_text(), flags=re.MULTILINE)
            ),
        ),
        2,
    ),
    "a lost pose": (SCENES, first_of("*.pose.txt", lambda p: np.savetxt(p, np.full((4, 4), np.nan))), 2),
    "a lost image": (SCENES, first_of(DEPTHS, lambda p: p.unlink()), 2),
    "no colors": (SCENES, all_of("*.color.*", lambda p: p.unlink()), 3),
    "larger colors": (SCENES, all_of("*.color.*", lambda p: put(p, np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8))), 3),
    "comments": ("tum", all_of("*.txt", lambda p: p.write_text("# a\n\n" + p.read_text())), 3),
    "UTF-16": ("tum", all_of("*.txt", lambda p: p.write_bytes(p.read_text().encode("utf-16"))), 3),
    "decimal commas": (
        "tum",
        all_of("groundtruth.txt", lambda p: p.write_text(p.read_text().replace(" ", ";").replace(".", ","))),
        3,
    ),
    "KITTI's poses": ("tum", trajectory(lines_of_kitti), 3),
    "12 numbers": ("replica", first_of("traj.txt", lambda p: np.savetxt(p, np.loadtxt(p)[:, :12])), 3),
    "a fisheye": ("nerfstudio", document(lambda d: d.update(camera_model="OPENCV_FISHEYE", k1=0.01)), 3),
}


@pytest.mark.parametrize("name", READ)
def test_what_apps_leave_is_read(name: str, tmp_path: Path) -> None:
    layout, change, count = READ[name]
    folder = tmp_path / "ein Ordner é"
    getattr(writers, layout)(folder, TRUTH)
    change(folder)
    recording = open_recording(folder)
    assert len(recording) == count
    places = np.stack([frame.T_world_camera for frame in recording.frames])
    np.testing.assert_allclose(places, TRUTH.poses[-count:], atol=1e-4)
    for frame, depth in zip(recording.frames, TRUTH.depths[-count:], strict=True):
        assert np.median(np.abs(frame.read().depth - depth)) < 0.03  # a lens moves some


def test_poses_of_euroc_are_read(tmp_path: Path) -> None:
    writers.tum(tmp_path, TRUTH)
    later(tmp_path)
    trajectory(lines_of_euroc)(tmp_path)
    recording = open_recording(tmp_path)
    np.testing.assert_allclose(recording.frames[1].T_world_camera, TRUTH.poses[1], atol=1e-4)


def test_intrinsics_of_a_larger_color_image_are_those_of_its_depth_image_too(tmp_path: Path) -> None:
    """As phones give them: the depth image is smaller, and one matrix is written, the color's."""
    writers.seven_scenes(tmp_path, TRUTH)
    all_of("*.color.*", lambda p: put(p, np.zeros((4 * HEIGHT, 4 * WIDTH, 3), np.uint8)))(tmp_path)
    intrinsics(np.diag([4.0, 4.0, 1.0]) @ (K + 0.0))(tmp_path)
    read = open_recording(tmp_path).frames[0].read()
    assert read.camera.K[0, 0] == pytest.approx(K[0, 0])
    assert read.color_camera is not None
    assert read.color_camera.K[0, 0] == pytest.approx(4.0 * K[0, 0])

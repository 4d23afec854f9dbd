"""Every layout gives back the recording that an independent writer wrote."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import DatasetError
from regnf_core.fields.build import open_field
from regnf_data.exr import read_exr
from regnf_data.recordings.camera import Camera, camera_of_values
from regnf_data.recordings.opening import is_recording, open_recording
from regnf_data.recordings.recording import Frame, Recording, as_posed_images
from regnf_fit.images.fusion import FusionOptions, fuse_images
from tests.data.recordings import writers
from tests.data.recordings.truth import HEIGHT, WIDTH, K, Truth, walk

HALF = writers.HALF
_BAGS = (("mcap", "16UC1", "tf"), ("mcap", "32FC1", "odometry"), ("sqlite3", "compressedDepth", "tf"))


@cache
def truth() -> Truth:
    return walk()


def assert_as_recorded(recording: Recording, step: float) -> None:
    """Every frame has the true depth to half a step, the true camera and color."""
    assert len(recording) == len(truth())
    for index, stored in enumerate(recording.frames):
        frame = stored.read()
        # Poses may differ by a rigid motion of the world: they are compared with the first one's.
        first = np.linalg.inv(recording.frames[0].T_world_camera) @ frame.T_world_camera
        wanted = np.linalg.inv(truth().poses[0]) @ truth().poses[index]
        np.testing.assert_allclose(first, wanted, atol=1e-6)
        np.testing.assert_allclose(frame.camera.K, K + HALF, atol=1e-6)
        measured = frame.depth > 0.0
        assert measured.mean() > 0.99
        np.testing.assert_allclose(frame.depth[measured], truth().depths[index][measured], atol=0.51 * step)
        assert frame.color is not None
        np.testing.assert_array_equal(frame.registered(frame.color), truth().colors[index])


@pytest.mark.parametrize("layout", writers.FOLDERS)
def test_a_layout_is_read_as_it_was_recorded(layout: str, tmp_path: Path) -> None:
    write, step = writers.FOLDERS[layout]
    recording = open_recording(write(tmp_path / "recording", truth()))
    assert_as_recorded(recording, step)
    if layout == "scannet":
        assert recording.notes == ("1 of 7 frames have no pose or no depth and are left out",)


@pytest.mark.parametrize(("storage", "coding", "poses"), _BAGS)
def test_a_bag_is_read_as_it_was_recorded(storage: str, coding: str, poses: str, tmp_path: Path) -> None:
    path = writers.bag(tmp_path / "bag", truth(), storage, coding, poses)
    assert_as_recorded(open_recording(path), 1e-3 if coding != "32FC1" else 1e-6)
    if storage == "mcap":
        assert_as_recorded(open_recording(next(path.glob("*.mcap"))), 1e-3 if coding != "32FC1" else 1e-6)


@pytest.mark.parametrize("camera", ["realsense", "ros", "kinect", "matrix", "numbers"])
def test_a_frame_alone_is_read_with_any_file_of_intrinsics(camera: str, tmp_path: Path) -> None:
    writers.depth_png(tmp_path / "depth.png", truth().depths[0], 4000.0 if camera == "realsense" else 1000.0)
    writers.png(tmp_path / "color.png", truth().colors[0])
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if camera == "realsense":
        text = f'{{"width": {WIDTH}, "height": {HEIGHT}, "fx": {fx}, "fy": {fy}, "ppx": {cx}, "ppy": {cy}'
        (tmp_path / "intrinsics.json").write_text(text + ', "coeffs": [0, 0, 0, 0, 0], "depth_scale": 0.00025}')
    elif camera == "ros":
        lines = [f"image_width: {WIDTH}", f"image_height: {HEIGHT}", "distortion_model: plumb_bob"]
        lines += ["camera_matrix:", "  rows: 3", "  cols: 3", f"  data: {K.ravel().tolist()}"]
        lines += ["distortion_coefficients:", "  data: [0, 0, 0, 0, 0]"]
        (tmp_path / "camera_info.yaml").write_text("\n".join(lines))
    elif camera == "kinect":
        (tmp_path / "calibration.json").write_text(f'{{"depth": {{"K": {K.tolist()}}}}}')
    elif camera == "matrix":
        writers.text(tmp_path / "cam_K.txt", K)
    else:
        (tmp_path / "intrinsics.txt").write_text(f"{fx} {fy} {cx} {cy}\n")
    recording = open_recording(tmp_path)
    frame = recording.frames[0].read()
    np.testing.assert_allclose(frame.depth, truth().depths[0], atol=0.00051)
    np.testing.assert_allclose(frame.camera.K, K + HALF)
    np.testing.assert_array_equal(frame.T_world_camera, np.eye(4))
    assert ("millimeters" in " ".join(recording.notes)) == (camera != "realsense")


PAIRS = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
YAML = f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  data: "
CAMERAS: dict[str, tuple[str, str]] = {
    "four numbers": ("camera.json", json.dumps([70, 72, 39, 31])),
    "rows": ("camera.json", json.dumps(K.tolist())),
    "P": ("camera.json", json.dumps({"P": np.hstack([K, np.zeros((3, 1))]).ravel().tolist()})),
    "numbers as text": ("camera.json", json.dumps({name: str(value) for name, value in PAIRS.items()})),
    "a mark of Windows": ("camera.json", "\ufeff" + json.dumps(PAIRS)),
    "color's first": ("rs.camera.json", json.dumps({"color": {**PAIRS, "fx": 600.0}, "depth": PAIRS})),
    "OpenCV": ("camera.yml", f"%YAML:1.0\n---\n{YAML}{K.ravel().tolist()}\n"),
    "ORB-SLAM": ("tum.camera.yaml", "%YAML:1.0\n" + "".join(f"Camera.{name}: {n}\n" for name, n in PAIRS.items())),
    "a topic's echo": ("camera_info.yaml", f"height: {HEIGHT}\nwidth: {WIDTH}\nk: {K.ravel().tolist()}\n---\n"),
    "Kalibr": ("camchain.yaml", f"cam0:\n  intrinsics: [70, 72, 39, 31]\n  resolution: [{WIDTH}, {HEIGHT}]\n"),
    "a table": ("camera_matrix.csv", "70,0,39\n0,72,31\n0,0,1\n"),
    "with the size": ("intrinsics.txt", f"{WIDTH} {HEIGHT} 70 72 39 31"),
    "with names": ("intrinsics.txt", "fx = 70, fy = 72\ncx = 39, cy = 31\n"),
}


@pytest.mark.parametrize("form", CAMERAS)
def test_intrinsics_are_read_however_they_are_written(form: str, tmp_path: Path) -> None:
    name, text = CAMERAS[form]
    writers.depth_png(tmp_path / "depth.png", truth().depths[0], 1000.0)
    (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "._camera.json").write_bytes(b"\0\5\x16\7")
    np.testing.assert_allclose(open_recording(tmp_path).frames[0].read().camera.K, K + HALF)


def test_intrinsics_are_read_from_an_array_and_a_lens_that_realsense_calls_inverse(tmp_path: Path) -> None:
    writers.depth_png(tmp_path / "depth.png", truth().depths[0], 1000.0)
    np.save(tmp_path / "K.npy", K)
    np.testing.assert_allclose(open_recording(tmp_path).frames[0].read().camera.K, K + HALF)
    said = {**PAIRS, "model": "distortion.inverse_brown_conrady", "coeffs": [-0.1, 0.02, 0.001, 0.0, 0.0]}
    found = camera_of_values(said, "camera")
    assert found is not None
    slopes = np.array([[0.4, -0.3], [0.1, 0.2]])
    brown = replace(found.camera, lens="brown")
    np.testing.assert_allclose(brown._bent(found.camera._bent(slopes)), slopes, atol=1e-4)


@pytest.mark.parametrize("compression", [0, 2, 3])
def test_depths_of_openexr(compression: int, tmp_path: Path) -> None:
    depth = truth().depths[0].astype(np.float32)
    writers.exr(tmp_path / "depth.exr", depth, compression)
    np.testing.assert_array_equal(read_exr(tmp_path / "depth.exr"), depth)


def test_a_folder_of_recordings_names_them(tmp_path: Path) -> None:
    for scene in ("000001", "000002"):
        writers.bop(tmp_path / "test" / scene, truth())
    with pytest.raises(DatasetError, match="contains 2: give one of test/000001, test/000002") as found:
        open_recording(tmp_path)
    assert found.value.reason == "DATASET_NOT_RECOGNIZED"


def test_a_lens_is_undone(tmp_path: Path) -> None:
    """Depth by the truth through a lens: the pinhole's image comes back where the lens saw it."""
    ideal = Camera(K + HALF, (HEIGHT, WIDTH))
    lens = Camera(K + HALF, (HEIGHT, WIDTH), "brown", (-0.2, 0.05, 0.001, -0.002, 0.0))
    # An image whose value is the slope of the ray, as the lens takes it: invert the lens by a fine search.
    rows, columns = np.indices((4 * HEIGHT, 4 * WIDTH)) / 4.0 + 0.125
    aim = ideal.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))
    seen = np.floor(lens.project(aim)).astype(int)
    inside = (seen >= 0).all(1) & (seen[:, 0] < WIDTH) & (seen[:, 1] < HEIGHT)
    image = np.zeros((HEIGHT, WIDTH))
    image[seen[inside, 1], seen[inside, 0]] = aim[inside, 0]
    pinhole, index = lens.undistorted()
    assert index is not None
    assert pinhole.lens == "none"
    taken = image[index[0], index[1]]
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    wanted = ideal.rays(np.stack([columns.ravel(), rows.ravel()], axis=1))[:, 0].reshape(HEIGHT, WIDTH)
    middle = (slice(15, 45), slice(20, 60))
    assert np.abs(taken - wanted)[middle].max() < 1.5 / K[0, 0]
    assert np.abs(image - wanted)[middle].max() > 1.5 / K[0, 0] * 0.5


@pytest.mark.long
def test_every_layout_gives_the_same_map(tmp_path: Path) -> None:
    """Distances on the grid of the truth's own map differ by less than a voxel, mostly by far less."""
    bounds = np.array([[-1.6, 0.2, -0.1], [1.2, 2.2, 1.5]])
    options = FusionOptions(voxel=0.03, observation_voxels=32)
    paths = {name: write(tmp_path / name, truth()) for name, (write, _) in writers.FOLDERS.items()}
    paths |= {"mcap": writers.bag(tmp_path / "mcap", truth()), "db3": writers.bag(tmp_path / "db3", truth(), "sqlite3")}
    own = [
        Frame(str(number), depth.astype(np.float32), Camera(K + HALF, (HEIGHT, WIDTH)), pose)
        for number, (depth, pose) in enumerate(zip(truth().depths, truth().poses, strict=True))
    ]
    report = fuse_images(as_posed_images(own, bounds), tmp_path / "own.safetensors", options)
    points = torch.from_numpy(np.random.default_rng(0).uniform(*bounds, size=(50_000, 3))).float()
    wanted = open_field(tmp_path / "own.safetensors").signed_distance(points)
    near = wanted.abs() < 2.0 * report.voxel
    for name, path in paths.items():
        recording = open_recording(path)
        fuse_images(recording.posed_images(range(len(recording)), bounds), tmp_path / f"{name}.safetensors", options)
        apart = (open_field(tmp_path / f"{name}.safetensors").signed_distance(points) - wanted).abs()[near]
        assert float(apart.quantile(0.99)) < report.voxel, name
        assert float(apart.median()) < 0.1 * report.voxel, name


def test_arrays_that_are_no_image_are_no_recording(tmp_path: Path) -> None:
    """A grid of distances, a map of blocks and a list of points are fields' files."""
    grid, keys = np.zeros((20, 20, 20), np.float32), np.zeros((90, 3), np.int32)
    np.savez(tmp_path / "grid.npz", sdf=grid, origin=np.zeros(3), spacing=0.1)
    np.savez(tmp_path / "map.npz", key=keys, value_000=np.zeros((90, 8, 8, 8, 1)))
    np.save(tmp_path / "points.npy", np.ones((500, 3)))
    assert not any(is_recording(tmp_path / name) for name in ("grid.npz", "map.npz", "points.npy"))
    np.save(tmp_path / "image.npy", np.ones((48, 64), np.float32))
    assert is_recording(tmp_path / "image.npy")

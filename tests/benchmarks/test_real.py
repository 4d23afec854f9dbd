"""Parts of the benchmark of recorded rooms, on frames that are made here: two balls before a wall."""

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.real.cases import Work, make_case, object_field
from benchmarks.real.drift import overlap
from benchmarks.real.fusion import fuse, open_fused, surface, voxel_of
from benchmarks.real.halves import INTERLEAVED
from benchmarks.real.maps import keep_observation, open_map
from benchmarks.real.objects import cut_grid, cut_points
from benchmarks.real.scenes import Thing, room_frame
from benchmarks.real.sequence import open_recording, posed_images
from regnf_core import Sim3
from regnf_core.fields.observation import observation_of
from regnf_core.schema.description import FREE, UNSEEN

BALL, RADIUS, WALL = np.array([0.0, 0.0, 1.5]), 0.2, 2.0
SMALL, SMALL_RADIUS = np.array([0.2, 0.15, 1.5]), 0.1
K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 59.5], [0.0, 0.0, 1.0]])
SHAPE = (120, 160)
VOXEL_M = 0.02
HALF_VOXEL = VOXEL_M / 2.0


def depth_at(position):
    """What a camera at ``position`` that looks along z measures; pixels are counted from their centers."""
    rows, columns = np.indices(SHAPE)
    rays = np.stack([columns, rows, np.ones(SHAPE)], axis=-1) @ np.linalg.inv(K).T
    depth = np.full(SHAPE, WALL - position[2])
    for center, radius in ((BALL, RADIUS), (SMALL, SMALL_RADIUS)):
        to_ball = center - position
        a, b = (rays**2).sum(-1), rays @ to_ball
        root = b**2 - a * (to_ball @ to_ball - radius**2)
        depth = np.where(root > 0.0, np.minimum(depth, (b - np.sqrt(np.maximum(root, 0.0))) / a), depth)
    return depth


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for number in range(16):
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * np.cos(0.7 * number), 0.3 * np.sin(0.7 * number), 0.0
        stem = f"frame-{number:06d}"
        depth = np.round(1000.0 * depth_at(pose[:3, 3])).astype(np.uint16)
        Image.fromarray(depth).save(folder / f"{stem}.depth.png")
        Image.new("RGB", SHAPE[::-1], (90, number, 0)).save(folder / f"{stem}.color.png")
        np.savetxt(folder / f"{stem}.pose.txt", pose)
    return open_recording(folder)


@pytest.fixture(scope="module")
def thing():
    frame = room_frame(np.array([0.0, -1.0, 0.0]))
    center = frame.apply(torch.from_numpy(BALL)[None])[0].numpy()
    return Thing("balls", center - 0.3, center + 0.3, frame)


@pytest.fixture(scope="module")
def work(tmp_path_factory, recording, thing):
    work = Work(tmp_path_factory.mktemp("work"), INTERLEAVED)
    for half, frames in zip("AB", work.halves.frames(len(recording)), strict=True):
        fuse(recording, frames, VOXEL_M, work.map_files(half).fused)
    cut_points(work.map_files("A").fused, thing, work.object_file(thing, "points"))
    cut_grid(work.map_files("A").fused, thing, work.object_file(thing, "grid"))
    return work


def test_images_keep_the_places_of_their_pixels(recording):
    T = Sim3.from_quaternion(0.5, [0.1, 0.2, 0.3, 0.9], [1.0, 2.0, 3.0])
    images = posed_images(recording, [5], T, np.array([[-1.0] * 3, [1.0] * 3]), stride=4)
    row, column = 12, 20  # shows the frame's pixel (48, 80)
    depth = images.depths[0, row, column]
    ray = np.linalg.inv(images.intrinsics[0]) @ [column + 0.5, row + 0.5, 1.0]
    found = images.T_world_camera[0] @ [*(depth * ray), 1.0]
    z = recording.depth(5)[48, 80]
    there = z * (np.linalg.inv(K) @ [80.0, 48.0, 1.0]) + recording.pose(5)[:3, 3]
    np.testing.assert_allclose(found[:3], T.apply(torch.from_numpy(there)[None])[0], atol=1e-6)


def test_the_fused_surface_is_the_scenes(work):
    vertices, normals = surface(work.map_files("A").fused)
    ball = (np.linalg.norm(vertices - BALL, axis=1) < RADIUS + 0.05) & (vertices[:, 0] < 0.0)
    assert np.median(np.abs(np.linalg.norm(vertices[ball] - BALL, axis=1) - RADIUS)) < HALF_VOXEL
    outward = (vertices[ball] - BALL) / RADIUS
    assert np.median((outward * normals[ball]).sum(1)) > 0.95


@pytest.mark.filterwarnings("ignore:.*SURFACE_RECONSTRUCTED")
@pytest.mark.parametrize("kind", ["points", "grid"])
def test_an_object_that_was_moved_agrees_with_the_map_at_the_truth(work, thing, kind):
    scene = open_fused(work.map_files("B").fused)
    case = make_case(scene, object_field(work, thing, kind), thing, 0, seed=3)
    vertices, _ = surface(work.map_files("B").fused)
    seen = vertices[(np.linalg.norm(vertices - BALL, axis=1) < RADIUS + 0.01) & (vertices[:, 2] < BALL[2] - 0.05)]
    moved = case.truth.apply(torch.from_numpy(seen))
    off = case.obj.signed_distance(moved.float()).abs() / float(case.truth.scale)
    assert float(off.median()) < HALF_VOXEL
    assert bool(case.detection.contains(torch.from_numpy(seen)).all())


def test_what_the_frames_saw(work, recording):
    _, frames = INTERLEAVED.frames(len(recording))
    files = work.map_files("B")
    keep_observation(recording, frames, files)
    seen = observation_of(open_map(files, "fused", "frames"))
    places = torch.tensor([[-0.35, 0.0, 1.5], [0.0, 0.0, 1.55]])
    assert seen.at(places).tolist() == [FREE, UNSEEN]
    assert observation_of(open_map(files, "fused", "none")) is None


def test_halves_without_drift_lie_on_each_other(work, thing):
    found = overlap(work.map_files("A").fused, work.map_files("B").fused, thing)
    assert found.drift_m < WALL / K[0, 0]  # a pixel's width: the images tell no more
    assert found.seen_share > 0.9


def test_a_map_keeps_its_voxel_and_its_truncation(recording, tmp_path):
    for voxel_m in (0.01, 0.02):
        path = tmp_path / f"{voxel_m}.npz"
        fuse(recording, range(0, 16, 4), voxel_m, path)
        assert voxel_of(path) == pytest.approx(voxel_m)
        # 5 voxels before the wall, beside both balls: within the truncation of 8, so the distance is told.
        before = torch.tensor([[-0.3, -0.3, WALL - 5.0 * voxel_m]])
        assert open_fused(path).signed_distance(before).item() == pytest.approx(5.0 * voxel_m, abs=0.5 * voxel_m)


def test_a_recording_without_intrinsics_names_the_file(recording, tmp_path):
    for path in recording.folder.glob("frame-*"):
        (tmp_path / path.name).symlink_to(path)
    with pytest.raises(FileNotFoundError, match=r"camera-intrinsics\.txt"):
        open_recording(tmp_path)

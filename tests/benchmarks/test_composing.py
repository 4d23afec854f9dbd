"""Rooms and objects as whole datasets: frames, truths, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.make_fields import UNITS_PER_METER
from benchmarks.worlds.composing import RenderOptions, render_object, render_room
from benchmarks.worlds.layouts import read_layout
from regnf_core.errors import DatasetError
from regnf_core.importing.mesh_file import load_mesh
from regnf_data.posed_images import PosedImages
from scripts import make_demo_fields as demo
from tests.benchmarks.rooms import CHEST, room, write_chest, write_room
from tests.devdata import dev_data

SMALL = {"size": (48, 64), "sensor": None}


def points_of(images: PosedImages) -> torch.Tensor:
    """All depths carried back into the world, (P, 3)."""
    assert images.depths is not None
    index, rows, columns = np.nonzero(images.depths)
    depth = images.depths[index, rows, columns].astype(np.float64)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=-1)
    local = np.einsum("nij,nj->ni", np.linalg.inv(images.intrinsics)[index], pixels) * depth[:, None]
    poses = images.T_world_camera[index]
    return torch.from_numpy(np.einsum("nij,nj->ni", poses[:, :3, :3], local) + poses[:, :3, 3])


def test_an_objects_depths_lie_on_it_in_the_librarys_frame(tmp_path: Path) -> None:
    mesh = load_mesh(write_chest(tmp_path / "chest.ply"))
    images = render_object(tmp_path / "chest.ply", RenderOptions(frames=8, **SMALL), units_per_meter=0.8)
    assert len(images) == 8
    assert images.size == (48, 64)
    library = mesh.transformed(demo.object_from_mesh(mesh, 0.8))
    points = points_of(images)
    assert len(points) > 2000
    assert library.signed_distance(points).abs().max() < 1e-6
    np.testing.assert_allclose(points.amax(dim=0), [0.24, 0.16, 0.2], atol=0.02)
    assert images.masks is not None
    np.testing.assert_array_equal(images.masks, images.depths > 0.0)
    assert 0.03 < images.masks.mean() < 0.9
    assert (images.colors[~images.masks] == 255).mean() > 0.9
    (chest,) = images.instances
    np.testing.assert_array_equal(chest.T_object_world, np.eye(4))
    np.testing.assert_allclose(chest.box.size, 0.8 * (CHEST[1] - CHEST[0]))
    np.testing.assert_allclose(images.T_metric_world @ [0, 0, 0, 1], [0, 0, 0.25, 1], atol=1e-12)
    np.testing.assert_allclose(images.T_metric_world @ chest.world_pose, chest.gt_pose, atol=1e-12)


def test_a_rooms_depths_lie_on_it_in_the_scenes_frame(tmp_path: Path) -> None:
    layout = read_layout(write_room(tmp_path), tmp_path)
    images = render_room(layout, RenderOptions("long", frames=10, **SMALL), object_units_per_meter={"b": 1.3})
    points = points_of(images)
    assert demo.compose_room(tmp_path, room()).signed_distance(points).abs().max() < 2e-6
    assert images.masks is None
    np.testing.assert_allclose(images.bounds, [[-1.1, -1.0, -0.55], [1.0, 1.0, 0.5]])
    names = [instance.label for instance in images.instances]
    assert names == ["a", "b"]
    # The chest's upper corner (.3, .2, .5), turned by 90 degrees and carried to (.9, .6), halved with z less one meter.
    corner = np.array([0.5 * (0.9 - 0.2), 0.5 * (0.6 + 0.3), 0.5 * (0.5 - 1.0), 1.0])
    T_object_world = images.instances[1].T_object_world
    assert T_object_world is not None
    np.testing.assert_allclose(T_object_world @ corner, [0.39, 0.26, 0.325, 1.0], atol=1e-12)
    np.testing.assert_allclose(images.instances[1].box.size, [0.2, 0.3, 0.25], atol=1e-12)


def test_single_views_are_about_one_instance(tmp_path: Path) -> None:
    layout = read_layout(write_room(tmp_path), tmp_path)
    images = render_room(layout, RenderOptions("single", **SMALL), instance="b")
    assert len(images) == 1
    (chest,) = images.instances
    assert chest.label == "b"
    assert (chest.box.corners() > torch.from_numpy(images.bounds[0])).all()
    assert np.linalg.norm(images.bounds[1] - images.bounds[0]) < 1.2
    assert int(chest.box.contains(points_of(images), margin=0.01).sum()) > 100


def test_noise_is_told_in_meters_and_decided_by_the_seed(tmp_path: Path) -> None:
    write_chest(tmp_path / "chest.ply")

    def depths(seed: int, **given: Any) -> Any:
        options = RenderOptions(frames=2, size=(48, 64), seed=seed, **given)
        return render_object(tmp_path / "chest.ply", options, units_per_meter=0.5).depths

    first, again, other, exact = depths(1), depths(1), depths(2), depths(1, sensor=None)
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    read = first > 0.0
    error = 2.0 * (first - exact)[read & (exact > 0.0)]
    assert 0.5 < np.median(np.abs(error)) / (0.6745 * 0.0013) < 2.0  # at about .7 m: 1.3 mm


def test_truths_and_boxes_are_those_of_the_benchmarks_fields() -> None:
    meshes, path = dev_data("furniture"), dev_data("rooms", "ac-room.json")
    written = json.loads(path.read_text())
    options = RenderOptions("short", frames=1, size=(12, 16))
    images = render_room(read_layout(path, meshes), options, object_units_per_meter=UNITS_PER_METER)
    for instance, entry in zip(images.instances, written["instances"], strict=True):
        mesh = demo.load_instance(meshes, entry)
        T_scene_mesh = demo.SCENE_FRAME.from_room() @ np.array(entry["T_room_from_object"])
        truth = demo.object_from_mesh(mesh, UNITS_PER_METER[entry["id"]]) @ np.linalg.inv(T_scene_mesh)
        np.testing.assert_allclose(instance.T_object_world, truth, atol=1e-8)
        detection = demo.detection(entry)
        np.testing.assert_allclose(instance.box.center, detection["center"], atol=1e-12)
        np.testing.assert_allclose(instance.box.size, detection["size"], atol=1e-12)


def test_refused_requests(tmp_path: Path) -> None:
    layout = read_layout(write_room(tmp_path), tmp_path)
    for options, given, reason in (
        (RenderOptions("single", **SMALL), {"instance": "z"}, "DATASET_NO_INSTANCE"),
        (RenderOptions("single", **SMALL), {}, "DATASET_NO_INSTANCE"),
        (RenderOptions("single", frames=2, **SMALL), {"instance": "a"}, "DATASET_FRAMES_INVALID"),
        (RenderOptions("long", frames=0, **SMALL), {}, "DATASET_FRAMES_INVALID"),
        (RenderOptions("short", frames=1, **SMALL), {"units_per_meter": -1.0}, "DATASET_SCALE_INVALID"),
        (RenderOptions("short", frames=1, **SMALL), {"units_per_meter": 0.0}, "DATASET_SCALE_INVALID"),
    ):
        with pytest.raises(DatasetError) as refused:
            render_room(layout, options, **given)  # type: ignore[arg-type]
        assert refused.value.reason == reason

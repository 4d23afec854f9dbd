"""Open3D's VoxelBlockGrid: files as its ``save`` lays them out, the truncation, voxels that nobody saw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from safetensors import safe_open

from regnf_core.errors import HINTS
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import has_color
from regnf_core.importing.containers.euclidean import PROJECTIVE
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.fields.grids import slow_trilinear
from tests.core.importing.archives import assert_refused
from tests.core.importing.test_reference_checkpoints import assert_reproduces
from tests.devdata import dev_data

EDGE, SIZE, RADIUS = 8, 0.05, 0.6
CENTER = np.array([0.1, -0.2, 0.05])


def true_distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(points - CENTER, axis=-1) - RADIUS)


def ball(voxels: float = 4.0, **changes: Any) -> dict[str, Any]:
    """The arrays of a map of a ball, cut off at ``voxels`` voxels; what lies deeper than that was never seen."""
    keys = np.stack(np.meshgrid(*[np.arange(-3, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    z, y, x = np.meshgrid(*[np.arange(EDGE)] * 3, indexing="ij")  # the file has x last
    distance = true_distance(SIZE * (EDGE * keys[:, None, None, None] + np.stack((x, y, z), axis=-1)))
    cut = voxels * SIZE
    kept = (np.abs(distance) < SIZE).any(axis=(1, 2, 3))
    distance, keys = distance[kept], keys[kept]
    seen = distance > -cut
    arrays = {
        "value_000": np.where(seen, np.minimum(distance / cut, 1.0), 0.0)[..., None].astype(np.float32),
        "value_001": seen[..., None].astype(np.float32),
        "value_002": np.zeros((*distance.shape, 3), np.float32),
        "key": keys.astype(np.int32),
        "attr_name_tsdf": np.array([0], np.int32),
        "attr_name_weight": np.array([1], np.int32),
        "attr_name_color": np.array([2], np.int32),
        "block_resolution": np.array([EDGE], np.int64),
        "voxel_size": np.array([SIZE], np.float32),
        "CPU:0": np.uint8(0),
    }
    arrays |= changes
    return {name: array for name, array in arrays.items() if array is not None}


def converted(folder: Path, arrays: dict[str, Any], overrides: dict[str, Any] | None = None) -> dict[str, Any]:
    np.savez(folder / "map.npz", **arrays)
    return convert_file(folder / "map.npz", folder, overrides, ImportLimits())


def near_surface(count: int) -> NDArray[np.float64]:
    """Points within a voxel of the ball's surface."""
    rng = np.random.default_rng(8)
    direction = rng.normal(size=(count, 3))
    reach = RADIUS + SIZE * rng.uniform(-1, 1, (count, 1))
    points: NDArray[np.float64] = CENTER + reach * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return points


@pytest.mark.parametrize("voxels", [4.0, 8.0])
def test_the_truncation_is_told_by_exact_distances_and_voxels_lie_where_they_should(
    tmp_path: Path, voxels: float
) -> None:
    report = converted(tmp_path, ball(voxels))
    assert report["family"] == "open3d_voxel_block_grid"
    assert report["warnings"] == []
    assert f"truncation of {voxels:g} voxels" in " ".join(report["why"])
    points = near_surface(100)
    distance, gradient = open_field(tmp_path / FIELD_NAME).signed_distance_and_gradient(torch.from_numpy(points))
    size = float(np.float32(SIZE))
    expected = [
        slow_trilinear(lambda node: float(true_distance(SIZE * np.array(node))), point / size) for point in points
    ]
    np.testing.assert_allclose(distance.numpy(), expected, rtol=0, atol=1e-5)
    outward = (points - CENTER) / np.linalg.norm(points - CENTER, axis=1, keepdims=True)
    assert np.abs(gradient.numpy() - outward).max() < 0.1


def test_the_attributes_arrays_are_told_by_name(tmp_path: Path) -> None:
    arrays = ball()
    arrays |= {"value_000": arrays["value_001"].astype(np.uint16), "value_001": arrays["value_000"]}
    arrays |= {"attr_name_tsdf": np.array([1]), "attr_name_weight": np.array([0])}
    assert converted(tmp_path, arrays)["warnings"] == []


def test_unseen_voxels_count_as_free_space_behind_what_was_seen(tmp_path: Path) -> None:
    """A block whose lower half was seen, 0.1 to 0.25 deep: from there on distances rise again."""
    tsdf = np.zeros((1, 4, 4, 4, 1), np.float32)
    weight = np.zeros_like(tsdf)
    tsdf[:, :2] = np.array([0.25, -0.25], np.float32).reshape(1, 2, 1, 1, 1)  # z is the first axis of a block
    weight[:, :2] = 1.0
    arrays = ball(value_000=tsdf, value_001=weight, value_002=None, attr_name_color=None, key=np.array([[-1, 2, 0]]))
    report = converted(tmp_path, arrays | {"block_resolution": np.array([4])}, {"truncation": 0.1})
    np.testing.assert_allclose(report["bounds"], [[-0.2, 0.4, 0.0], [-0.05, 0.55, 0.05]], rtol=0, atol=1e-6)
    points = torch.tensor([[-0.1, 0.5, z] for z in (0.0, 0.05, 0.1, 0.15, 0.25)])
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(points)
    torch.testing.assert_close(distance, torch.tensor([0.025, -0.025, 0.025, 0.075, 0.175]), rtol=0, atol=1e-5)


def test_a_map_with_the_other_sign_is_filled_the_other_way(tmp_path: Path) -> None:
    arrays = ball()
    points = torch.from_numpy(np.random.default_rng(1).uniform(-1.5, 1.5, (200, 3)))
    converted(tmp_path, arrays)
    expected = open_field(tmp_path / FIELD_NAME).signed_distance(points)
    converted(tmp_path, arrays | {"value_000": -arrays["value_000"]}, {"sign": -1})
    torch.testing.assert_close(open_field(tmp_path / FIELD_NAME).signed_distance(points), expected)


def test_the_uploader_may_tell_the_truncation(tmp_path: Path) -> None:
    converted(tmp_path, ball(4.0), {"truncation": 0.1, "world_scale": 10.0})
    surface = torch.from_numpy(10.0 * (CENTER + np.array([RADIUS + 0.05, 0.0, 0.0])))[None]
    assert float(open_field(tmp_path / FIELD_NAME).signed_distance(surface)) == pytest.approx(0.25, abs=0.02)


def fused(voxels: float, aslant: float = 0.0) -> dict[str, Any]:
    """A map of a box and the floor under it, fused by Open3D at ``voxels`` voxels, as cameras round it see it."""
    boxes = [
        trimesh.creation.box(bounds=[[-0.3, -0.25, 0.0], [0.3, 0.25, 0.5]]),
        trimesh.creation.box(bounds=[[-1.0, -1.0, -0.1], [1.0, 1.0, 0.0]]),
    ]
    rays = open3d.t.geometry.RaycastingScene()
    for box in boxes:
        triangles = box.vertices.astype(np.float32), box.faces.astype(np.uint32)
        rays.add_triangles(*(open3d.core.Tensor.from_numpy(part) for part in triangles))
    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"),
        (open3d.core.float32,) * 2,
        (open3d.core.SizeVector([1]),) * 2,
        0.02,
        16,
        2000,
        open3d.core.Device("CPU:0"),
    )
    K = open3d.core.Tensor.from_numpy(np.array([[160.0, 0.0, 79.5], [0.0, 160.0, 59.5], [0.0, 0.0, 1.0]]))
    for turn in np.arange(8) * np.pi / 4 + aslant:
        forward = -np.array([1.3 * np.cos(turn), 1.3 * np.sin(turn), 0.25])
        z = forward / np.linalg.norm(forward)
        x = np.cross(z, [0.0, 0.0, 1.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z], axis=1)
        pose[:3, 3] = np.array([0.0, 0.0, 0.25]) - forward
        T = open3d.core.Tensor.from_numpy(np.linalg.inv(pose))
        depth = rays.cast_rays(rays.create_rays_pinhole(K, T, 160, 120))["t_hit"].numpy()
        image = open3d.t.geometry.Image(
            open3d.core.Tensor.from_numpy((np.where(depth < 5, depth, 0) * 1e4).astype(np.uint16))
        )
        blocks = grid.compute_unique_block_coordinates(image, K, T, 1e4, 4.0, voxels)
        grid.integrate(blocks, image, K, T, 1e4, 4.0, voxels)
    tables = {name: grid.attribute(name).cpu().numpy() for name in ("tsdf", "weight")}
    rows = grid.hashmap().active_buf_indices().cpu().numpy().astype(np.int64)
    return {
        "value_000": tables["tsdf"][rows],
        "value_001": tables["weight"][rows],
        "key": grid.hashmap().key_tensor().cpu().numpy()[rows],
        "attr_name_tsdf": np.array([0]),
        "attr_name_weight": np.array([1]),
        "block_resolution": np.array([16]),
        "voxel_size": np.array([0.02]),
    }


def before_the_box(arrays: dict[str, Any], voxels: float) -> tuple[NDArray[np.float64], ...]:
    """Nodes that were seen before a surface of the exact scene, their distances, and what the file says of them."""
    seen = np.argwhere(arrays["value_001"][..., 0] > 0)
    block, z, y, x = seen.T
    nodes = 0.02 * (16 * arrays["key"][block] + np.stack((x, y, z), axis=1))
    true = np.minimum(
        outside(nodes, [0.0, 0.0, 0.25], [0.3, 0.25, 0.25]), outside(nodes, [0.0, 0.0, -0.05], [1.0, 1.0, 0.05])
    )
    before = (true > 0.01) & (true < 0.08) & (np.abs(nodes[:, :2]).max(axis=1) < 0.7)
    stored = 0.02 * voxels * arrays["value_000"][tuple(seen.T)][before, 0]
    return nodes[before], true[before], stored


def test_fused_distances_become_those_to_the_surface(tmp_path: Path) -> None:
    """Before surfaces that were seen at an angle the file's values are too large; the exact scene is known."""
    arrays = fused(8.0)
    report = converted(tmp_path, arrays, {"truncation": 0.16})
    assert PROJECTIVE in report["why"]
    assert report["warnings"] == []
    nodes, true, stored = before_the_box(arrays, 8.0)
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(torch.from_numpy(nodes)).numpy()
    assert np.median(np.abs(stored - true)) > 0.04
    assert (np.abs(distance) <= np.abs(stored) + 1e-6).all()
    assert np.median(np.abs(distance - true)) < 0.002  # what stands behind another thing was not seen


@pytest.mark.parametrize(
    ("voxels", "aslant"), [(4.0, 0.0), (5.0, 0.2), (8.0, 0.0), (10.0, 0.2), (12.0, 0.0), (16.0, 0.2)]
)
def test_distances_are_right_whatever_they_were_divided_by(tmp_path: Path, voxels: float, aslant: float) -> None:
    """The file does not say it: nothing is refused, and a warning says where distances are cut off."""
    arrays = fused(voxels, aslant)
    report = converted(tmp_path, arrays)
    assert [warning.split(":")[0] for warning in report["warnings"]] == ["TRUNCATION_ASSUMED"]
    assert "up to 0.16 (8 voxels, Open3D's default)" in report["warnings"][0]
    nodes, true, stored = before_the_box(arrays, voxels)
    free = stored > 0.0  # wide truncations reach through the box to its other side, and are matter there
    nodes, true = torch.from_numpy(nodes[free]), true[free]
    distance = open_field(tmp_path / FIELD_NAME).signed_distance(nodes).numpy()
    converted(tmp_path, arrays, {"truncation": 0.02 * voxels})
    told = open_field(tmp_path / FIELD_NAME).signed_distance(nodes).numpy()
    assert np.median(np.abs(distance - true)) < 1.05 * np.median(np.abs(told - true)) < 0.003
    assert np.median(np.abs(distance / told - 1.0)) < 0.01


def outside(points: NDArray[np.float64], center: list[float], half: list[float]) -> NDArray[np.float64]:
    """Distances of points (N, 3) that are outside of a box."""
    return np.asarray(np.linalg.norm(np.maximum(np.abs(points - center) - half, 0.0), axis=1))


def test_values_that_were_not_divided_by_a_truncation_are_asked_about(tmp_path: Path) -> None:
    arrays = ball(4.0)
    arrays["value_000"] = 40.0 * arrays["value_000"]
    assert_refused(lambda: converted(tmp_path, arrays), "TRUNCATION_UNKNOWN")
    assert "--scene-description" in HINTS["TRUNCATION_UNKNOWN"]


def test_weights_are_kept_and_zero_where_nothing_was_seen(tmp_path: Path) -> None:
    arrays = ball(4.0)
    arrays["value_001"] = arrays["value_001"] * 7.0
    converted(tmp_path, arrays)
    with safe_open(tmp_path / FIELD_NAME, framework="numpy") as file:
        weights = file.get_tensor("weights")
    seen = arrays["value_001"][..., 0].transpose(0, 3, 2, 1)
    np.testing.assert_array_equal(weights, seen[seen.any(axis=(1, 2, 3))])
    assert set(np.unique(weights)) == {0.0, 7.0}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"value_000": None}, "TENSOR_MISSING"),
        ({"key": np.zeros((5, 3), np.int32)}, "TENSOR_SHAPE"),
        ({"key": np.zeros((5, 2), np.int32)}, "TENSOR_SHAPE"),
        ({"key": np.zeros((0, 3), np.int32)}, "TENSOR_SHAPE"),
        ({"key": np.zeros((5, 3), np.float32)}, "TENSOR_DTYPE"),
        ({"key": np.full((5, 3), -(1 << 63))}, "TENSOR_SHAPE"),
        ({"block_resolution": np.array([0])}, "TENSOR_SHAPE"),
        ({"block_resolution": np.array([8, 8])}, "TENSOR_SHAPE"),
        ({"block_resolution": np.array([1 << 40])}, "TENSOR_SHAPE"),
        ({"voxel_size": np.array([-0.05])}, "TENSOR_SHAPE"),
        ({"voxel_size": np.array([np.nan])}, "TENSOR_NOT_FINITE"),
        ({"attr_name_tsdf": np.array([-1])}, "TENSOR_SHAPE"),
        ({"attr_name_tsdf": np.array([2])}, "TENSOR_SHAPE"),
        ({"attr_name_tsdf": np.array([7])}, "TENSOR_MISSING"),
        ({"attr_name_tsdf": None}, "FIELD_NOT_RECOGNIZED"),
    ],
)
def test_faulty_maps_are_refused(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    assert_refused(lambda: converted(tmp_path, ball(**changes)), reason)


def test_a_block_that_occurs_twice_and_a_map_of_nothing_are_refused(tmp_path: Path) -> None:
    arrays = ball()
    twice = arrays["key"].copy()
    twice[1] = twice[0]
    assert_refused(lambda: converted(tmp_path, arrays | {"key": twice}), "FIELD_INDEX_INVALID")
    unseen = np.zeros_like(arrays["value_001"])
    assert_refused(lambda: converted(tmp_path, arrays | {"value_001": unseen}), "TENSOR_SHAPE")


def test_the_reference_file_is_reproduced(tmp_path: Path) -> None:
    folder = dev_data("formats", "open3d_voxel_block_grid")
    report = convert_file(folder / "vbg_torus.npz", tmp_path, None, ImportLimits())
    assert report["warnings"] == []
    assert_reproduces(tmp_path / FIELD_NAME, folder)
    field = open_field(tmp_path / FIELD_NAME)
    seen = np.load(folder / "voxel_weight.npy").reshape(-1) > 0
    at_voxels = field.signed_distance(torch.from_numpy(np.load(folder / "voxel_points.npy"))).numpy()
    stored = np.load(folder / "voxel_sdf.npy").reshape(-1)
    np.testing.assert_allclose(at_voxels[seen], stored[seen], rtol=0, atol=1e-5 * np.ptp(stored))


def test_colors_are_kept(tmp_path: Path) -> None:
    """Of what was seen, shares of 255; all black means that no colors were given."""
    rng = np.random.default_rng(2)
    shape = ball()["value_002"].shape
    paint = rng.integers(1, 256, shape).astype(np.uint16)  # as Open3D stores them, or as floats
    report = converted(tmp_path, ball(value_002=paint))
    assert not [warning for warning in report["warnings"] if warning.startswith("COLOR")]
    field = open_field(tmp_path / FIELD_NAME)
    assert has_color(field)
    arrays = ball()
    seen = np.argwhere(arrays["value_001"][..., 0] > 0)[::97]
    block, z, y, x = seen.T
    points = SIZE * (EDGE * arrays["key"][block] + np.stack((x, y, z), axis=-1))
    found = field.color(torch.from_numpy(points + 1e-7), torch.zeros(len(points), 3)).numpy()
    np.testing.assert_allclose(found, paint[block, z, y, x] / 255.0, rtol=0, atol=2e-3)
    (tmp_path / "black").mkdir()
    converted(tmp_path / "black", ball())
    assert not has_color(open_field(tmp_path / "black" / FIELD_NAME))


FAR = np.array([1_250_000, -9_000_001, 300])
"""Blocks: half a million meters, and more."""


def test_a_map_far_from_the_origin_is_the_same_map(tmp_path: Path) -> None:
    near_folder, far_folder = tmp_path / "near", tmp_path / "far"
    near_folder.mkdir()
    far_folder.mkdir()
    converted(near_folder, ball())
    converted(far_folder, ball() | {"key": ball()["key"] + FAR.astype(np.int32)})
    near, far = (open_field(folder / FIELD_NAME) for folder in (near_folder, far_folder))
    shift = torch.from_numpy(FAR * EDGE * float(np.float32(SIZE)))
    points = torch.from_numpy(near_surface(500))
    distance, gradient = near.signed_distance_and_gradient(points)
    moved, slope = far.signed_distance_and_gradient(points + shift)
    torch.testing.assert_close(moved, distance, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(slope, gradient, atol=1e-3, rtol=0.0)
    torch.testing.assert_close(far.bounds, near.bounds + shift, atol=1e-6, rtol=0.0)

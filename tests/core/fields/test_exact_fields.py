"""Exact fields: meshes against formulas, boxes by hand, unions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.solids import BoxField, UnionField
from regnf_core.fields.composite import SurfaceSource
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.importing.mesh_file import load_mesh
from tests.core.importing.archives import assert_refused

BOX = BoxField((-0.3, -0.2, -0.1), (0.3, 0.2, 0.5))


def box_mesh(box: BoxField) -> MeshField:
    mesh = trimesh.creation.box(bounds=[box.lower, box.upper])
    return MeshField(mesh.vertices, mesh.faces)


def some_points(count: int = 400, reach: float = 1.0) -> torch.Tensor:
    return reach * (2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(4)) - 1.0)


def test_box_by_hand() -> None:
    points = torch.tensor([[0.0, 0.0, 0.3], [0.6, 0.6, 0.2], [0.0, 0.0, -0.4], [0.25, 0.0, 0.2]])
    distance, gradient = BOX.signed_distance_and_gradient(points)
    torch.testing.assert_close(distance, torch.tensor([-0.2, 0.5, 0.3, -0.05]))
    expected = torch.tensor([[0.6, 0.8, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    torch.testing.assert_close(gradient[1:], expected)
    assert BOX.area == pytest.approx(2 * (0.6 * 0.4 + 0.4 * 0.6 + 0.6 * 0.6))


def test_mesh_of_a_box_agrees_with_the_formula() -> None:
    points = some_points()
    distance, gradient = box_mesh(BOX).signed_distance_and_gradient(points)
    expected, slope = BOX.signed_distance_and_gradient(points)
    torch.testing.assert_close(distance, expected, rtol=0, atol=1e-6)
    assert (distance < 0).any()
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1e-4)
    assert isinstance(box_mesh(BOX), SdfField)

    distance, gradient = box_mesh(BOX).signed_distance_and_gradient(torch.tensor([[0.1, 0.05, 0.5]]))
    torch.testing.assert_close(distance, torch.zeros(1))
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 0.0, 1.0]]))


def test_mesh_moves() -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = 0.5 * Rotation.from_rotvec([0.2, 0.4, 0.6]).as_matrix()
    matrix[:3, 3] = [0.1, -0.2, 0.3]
    points = some_points()
    moved = torch.from_numpy(points.double().numpy() @ matrix[:3, :3].T + matrix[:3, 3]).float()
    there = box_mesh(BOX).transformed(matrix).signed_distance(moved)
    torch.testing.assert_close(there, 0.5 * BOX.signed_distance(points), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]]),
        (np.full((3, 3), np.nan), [[0, 1, 2]]),
        (np.eye(3), np.zeros((0, 3))),
        (np.eye(3), [[0, 1, 3]]),
    ],
)
def test_what_is_no_mesh_is_refused(vertices: object, faces: object) -> None:
    assert_refused(lambda: MeshField(np.asarray(vertices), np.asarray(faces)), "MESH_INVALID")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *((f"words.{kind}", "no mesh at all") for kind in ("glb", "obj", "ply", "stl")),
        ("parts.gltf", '{"asset": {"version": "2.0"}, "buffers": [{"uri": "absent.bin", "byteLength": 3}]}'),
        ("short.obj", "v 0 0\nv 1 0 0\nv 0 1\nf 1 2 3\n"),
        ("far.obj", "v 0 0 0\nv 1 0 0\nf 1 2 9\n"),
    ],
)
def test_files_that_hold_no_sound_mesh_are_refused(name: str, content: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    assert_refused(lambda: load_mesh(tmp_path / name), "MESH_INVALID")
    with pytest.raises(FileNotFoundError):
        load_mesh(tmp_path / "absent.glb")
    with pytest.raises(IsADirectoryError):
        load_mesh(tmp_path)


def test_surface_samples_lie_on_the_surface() -> None:
    rng = np.random.default_rng(0)
    for field in (BOX, box_mesh(BOX), UnionField([BOX, BoxField((1, 1, 1), (2, 2, 2))])):
        assert isinstance(field, SurfaceSource)
        points = torch.from_numpy(field.sample_surface(500, rng)).float()
        torch.testing.assert_close(field.signed_distance(points), torch.zeros(500), rtol=0, atol=1e-6)


def test_union_takes_the_nearest() -> None:
    other = BoxField((0.5, 0.5, 0.5), (0.9, 0.9, 0.9))
    points = some_points(1000, reach=1.5)
    distance, gradient = UnionField([other, BOX]).signed_distance_and_gradient(points)
    expected = torch.minimum(BOX.signed_distance(points), other.signed_distance(points))
    torch.testing.assert_close(distance, expected)
    nearest = torch.where(
        (BOX.signed_distance(points) < other.signed_distance(points))[:, None],
        BOX.signed_distance_and_gradient(points)[1],
        other.signed_distance_and_gradient(points)[1],
    )
    torch.testing.assert_close(gradient, nearest)
    union = UnionField([other, BOX])
    double, slope = union.signed_distance_and_gradient(points.double())
    assert double.dtype == slope.dtype == torch.float32
    torch.testing.assert_close(double, distance)
    assert union.signed_distance(points[:0]).shape == (0,)


def test_union_shares_samples_by_weight() -> None:
    far = BoxField((1, 1, 1), (2, 2, 2))
    points = UnionField([BOX, far], weights=[3.0, 1.0]).sample_surface(2000, np.random.default_rng(0))
    share = (points[:, 0] < 0.9).mean()
    assert share == pytest.approx(0.75, abs=0.04)

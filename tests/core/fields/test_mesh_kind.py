"""The kind mesh: the exact distance, from a safe field file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from regnf_core.fields.build import open_field
from regnf_core.fields.mesh import MeshField
from regnf_core.native.library import SWITCH
from regnf_core.schema.safe_format import read_description, write_safe_field
from tests.core.importing.archives import assert_refused

DESCRIPTION = {"kind": "mesh", "bounds": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]}


def sphere() -> dict[str, np.ndarray[Any, Any]]:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    return {"vertices": ball.vertices.astype(np.float32), "faces": ball.faces.astype(np.int32)}


def test_a_sphere_is_read_back(tmp_path: Path) -> None:
    write_safe_field(tmp_path / "f", DESCRIPTION | {"label": "ball"}, sphere())
    assert read_description(tmp_path / "f")["label"] == "ball"
    field = open_field(tmp_path / "f")
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    distance, gradient = field.signed_distance_and_gradient(points)
    radius = points.norm(dim=1)
    # A chord of the icosphere lies at most 0.5 (1 - cos(edge / 2)) < 1.5e-3 below the sphere.
    torch.testing.assert_close(distance, radius - 0.5, rtol=0, atol=1.5e-3)
    assert ((gradient * points).sum(dim=1) / radius)[radius > 0.1].min() > 0.99
    assert field.bounds.tolist() == DESCRIPTION["bounds"]


def test_unit_and_sign_go_round_it(tmp_path: Path) -> None:
    write_safe_field(tmp_path / "f", {"kind": "mesh", "bounds": [[-3.0] * 3, [3.0] * 3], "world_scale": 2.0}, sphere())
    assert open_field(tmp_path / "f").signed_distance(torch.tensor([[2.0, 0.0, 0.0]])).item() == pytest.approx(
        1.0, abs=3e-3
    )
    write_safe_field(tmp_path / "f", DESCRIPTION | {"sign": -1}, sphere())
    assert open_field(tmp_path / "f").signed_distance(torch.zeros(1, 3)).item() > 0.49


def test_a_query_looks_at_the_normals_of_touched_triangles_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan has a million triangles: what looks at all of them for each batch of points takes most of the time."""
    monkeypatch.setenv(SWITCH, "0")
    mesh = sphere()
    field = MeshField(mesh["vertices"], mesh["faces"])
    field.signed_distance(torch.zeros(1, 3))
    monkeypatch.setattr("regnf_core.fields.mesh.igl", None)  # its trees are not built a second time
    given = []
    inner = MeshField._normals_and_areas
    monkeypatch.setattr(
        MeshField, "_normals_and_areas", lambda self, faces: given.append(len(faces)) or inner(self, faces)
    )
    on_surface = torch.from_numpy(field.vertices[:1])
    _, gradient = field.signed_distance_and_gradient(torch.cat((torch.zeros(5, 3, dtype=torch.float64), on_surface)))
    assert given == [1]
    assert float(gradient[-1] @ torch.nn.functional.normalize(on_surface[0], dim=0).float()) > 0.9


def blade() -> trimesh.Trimesh:
    """A wedge whose edge has an angle of 6 degrees: near it the normal of one face says nothing of the side."""
    vertices = [[0, -1, 0.05], [0, -1, -0.05], [1, -1, 0], [0, 1, 0.05], [0, 1, -0.05], [1, 1, 0]]
    faces = [[0, 1, 2], [3, 5, 4], [0, 3, 1], [3, 4, 1], [0, 2, 3], [2, 5, 3], [1, 4, 2], [4, 5, 2]]
    return trimesh.Trimesh(vertices, faces)


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.icosphere(2),
        trimesh.creation.box([1, 2, 0.01]),
        trimesh.creation.annulus(0.4, 0.5, 1.0),
        blade(),
    ],
)
def test_normals_of_a_closed_mesh_say_the_side(mesh: trimesh.Trimesh) -> None:
    assert mesh.is_watertight
    assert mesh.volume > 0
    field = MeshField(mesh.vertices, mesh.faces)
    assert field._normals is not None
    points = np.random.default_rng(1).uniform(-1.2, 1.2, (4000, 3)) * mesh.extents
    points[::2] = field.sample_surface(2000, np.random.default_rng(2)) + points[::2] * 0.01
    inside = field.signed_distance(torch.from_numpy(points)).numpy() < 0
    exact = np.abs(winding_number(mesh, points)) > 0.5
    assert 20 < exact.sum() < 3980
    np.testing.assert_array_equal(inside, exact)


def together(*parts: trimesh.Trimesh) -> tuple[Any, Any]:
    whole = trimesh.util.concatenate(list(parts))
    return whole.vertices, whole.faces


def winding_number(mesh: trimesh.Trimesh, points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The sum of the triangles' solid angles over 4 pi (van Oosterom and Strackee 1983)."""
    a, b, c = (mesh.triangles[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    top = np.einsum("nfx,nfx->nf", a, np.cross(b, c))
    ab, bc, ca = ((u * v).sum(-1) for u, v in ((a, b), (b, c), (c, a)))
    return np.arctan2(top, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2 * np.pi)


def test_the_winding_number_says_the_side_where_normals_cannot() -> None:
    crossing = trimesh.util.concatenate([trimesh.creation.box([2, 1, 1]), trimesh.creation.box([1, 2, 1])])
    corner = trimesh.creation.box([2, 1, 1])  # of it so little lies within the other that no point tried would tell
    corner.apply_translation([1.499, 0.999, 0.999])
    assert MeshField(*together(trimesh.creation.box([1, 1, 1]), corner))._normals is None
    corner.apply_translation([0.002, 0.002, 0.002])
    assert MeshField(*together(trimesh.creation.box([1, 1, 1]), corner))._normals is not None
    opened = trimesh.creation.box([1, 1, 1])
    opened.update_faces(np.arange(len(opened.faces)) != 0)
    for mesh, points in (
        (crossing, [[0.0, 0.499, 0.0], [0.7, 0.7, 0.0]]),
        (opened, [[0.0, 0.0, 0.0], [0.7, 0.7, 0.0]]),
    ):
        field = MeshField(mesh.vertices, mesh.faces)
        assert field._normals is None
        assert (field.signed_distance(torch.tensor(points)) < 0).tolist() == [True, False]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"faces": np.zeros((4, 3), np.float32)}, "FIELD_SHAPES_MISMATCH"),
        ({"vertices": np.zeros((4, 3), np.int32)}, "FIELD_SHAPES_MISMATCH"),
        ({"faces": np.zeros((0, 3), np.int32)}, "FIELD_SHAPES_MISMATCH"),
        ({"faces": np.zeros((4, 4), np.int32)}, "FIELD_SHAPES_MISMATCH"),
        ({"normals": np.zeros((4, 3), np.float32)}, "FIELD_SHAPES_MISMATCH"),
        ({"vertices": np.full((4, 3), np.nan, np.float32)}, "FIELD_NOT_FINITE"),
    ],
)
def test_what_is_no_mesh_is_not_written(change: dict[str, Any], reason: str, tmp_path: Path) -> None:
    assert_refused(lambda: write_safe_field(tmp_path / "f", DESCRIPTION, sphere() | change), reason)


@pytest.mark.parametrize("index", [-1, 4, 2**31 - 1])
def test_faces_of_no_vertex_are_refused_on_opening(index: int, tmp_path: Path) -> None:
    tensors = {"vertices": np.eye(4, 3, dtype=np.float32), "faces": np.array([[0, 1, index]], np.int32)}
    write_safe_field(tmp_path / "f", DESCRIPTION, tensors)
    assert_refused(lambda: open_field(tmp_path / "f"), "MESH_INVALID")

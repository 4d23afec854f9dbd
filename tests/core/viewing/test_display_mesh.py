"""The meshes that people look at: bounded, true to the surface, and read by others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from regnf_core.fields.composite import TransformedField
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.importing.gate.gate import import_field
from regnf_core.viewing import field_views as module
from regnf_core.viewing.field_views import (
    COARSE_TRIANGLES,
    FINE_TRIANGLES,
    FINE_VERTICES,
    TooSlowError,
    Triangles,
    clustered,
    display_meshes,
    field_views,
    mesh_file,
)
from tests.core.analytic import sphere


def test_mesh_is_shown_as_it_is() -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    shown = display_meshes(MeshField(box.vertices, box.faces), budget_s=1.0)
    assert shown.coarse is None
    assert shown.fine.normals is None
    assert trimesh.Trimesh(shown.fine.vertices, shown.fine.faces).volume == pytest.approx(6.0)


def test_large_mesh_is_bounded_and_stays_on_its_surface() -> None:
    ball = trimesh.creation.icosphere(7)
    colors = np.broadcast_to(np.float32([0.2, 0.4, 0.6]), ball.vertices.shape)
    shown = display_meshes(MeshField(ball.vertices, ball.faces, colors=colors), budget_s=1.0)
    assert len(ball.faces) > FINE_TRIANGLES
    assert FINE_TRIANGLES / 4 < len(shown.fine.faces) <= FINE_TRIANGLES
    assert len(shown.fine.vertices) <= FINE_VERTICES
    assert shown.coarse is not None
    assert COARSE_TRIANGLES / 4 < len(shown.coarse.faces) <= COARSE_TRIANGLES
    np.testing.assert_allclose(np.linalg.norm(shown.fine.vertices, axis=1), 1.0, atol=1e-3)
    assert shown.fine.colors is not None
    np.testing.assert_allclose(
        shown.fine.colors, np.broadcast_to([0.2, 0.4, 0.6], shown.fine.vertices.shape), atol=1e-6
    )


def test_field_is_extracted_with_normals() -> None:
    shown = display_meshes(sphere(0.5), budget_s=20.0)
    assert shown.fine.normals is not None
    np.testing.assert_allclose(np.linalg.norm(shown.fine.vertices, axis=1), 0.5, atol=2e-3)
    np.testing.assert_allclose(shown.fine.normals, shown.fine.vertices / 0.5, atol=1e-2)
    corners = shown.fine.vertices[shown.fine.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * corners.mean(axis=1)).sum(axis=1) >= 0).mean() > 0.99  # triangles face free space


def test_slow_field_has_no_mesh() -> None:
    with pytest.raises(TooSlowError):
        display_meshes(sphere(0.5), budget_s=0.0)


def test_clustering_by_hand() -> None:
    """Two vertices in one cell become their mean; the triangle that joins them is gone."""
    vertices = np.array([[0.0, 0, 0], [0.2, 0, 0], [2.5, 0, 0], [0, 2.5, 0]])
    found = clustered(Triangles(vertices, np.array([[0, 1, 2], [0, 2, 3], [1, 2, 3]])), edge=1.0)
    np.testing.assert_allclose(sorted(found.vertices.tolist()), [[0, 2.5, 0], [0.1, 0, 0], [2.5, 0, 0]])
    assert len(found.faces) == 1


def test_files_are_read_by_others(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2)
    path = tmp_path / "mesh.glb"
    colors = np.broadcast_to([1.0, 0.5, 0.0], ball.vertices.shape)
    path.write_bytes(mesh_file(ball.vertices, ball.faces, ball.vertex_normals, colors))
    read = trimesh.load(path, force="mesh")
    np.testing.assert_allclose(read.vertices, ball.vertices, atol=1e-6)
    assert (np.asarray(read.faces) == ball.faces).all()
    assert read.visual.vertex_colors[0].tolist() == [255, 128, 0, 255]


@pytest.mark.parametrize("own_triangles", [True, False])
def test_a_mesh_far_from_the_origin_keeps_its_digits(own_triangles: bool, tmp_path: Path) -> None:
    shift = np.array([448_262.25, 5_413_920.5, 112.0])
    near: SdfField = sphere(0.4)
    if own_triangles:
        ball = trimesh.creation.icosphere(3, radius=0.4)
        near = MeshField(ball.vertices, ball.faces)
    placed = TransformedField(near, Sim3.from_translation(-torch.from_numpy(shift)))
    here, there = (display_meshes(field, budget_s=1e3).fine for field in (near, placed))
    assert len(there.faces) == len(here.faces)
    path = tmp_path / "mesh.glb"
    path.write_bytes(mesh_file(there.vertices, there.faces))
    read = trimesh.load_scene(path).to_geometry()
    np.testing.assert_allclose(read.vertices - shift, here.vertices, atol=1e-5)


# A field's views.


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    axis = np.linspace(-1.0, 1.0, 24, dtype=np.float32)
    values = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - np.float32(0.5)
    np.savez(folder / "ball.npz", sdf=values, bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    import_field(folder / "ball.npz", folder / "out")
    return folder / "out" / "field.safetensors"


def test_a_field_is_drawn(ball: Path) -> None:
    found = field_views(ball)
    assert found.fine is not None
    assert found.coarse is not None
    assert found.picture is not None
    assert found.fine[:4] == found.coarse[:4] == b"glTF"
    assert len(found.coarse) < len(found.fine)
    assert found.picture.startswith(b"\x89PNG")


def test_a_field_that_is_too_slow_has_nothing_to_look_at(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_BUDGET_S", 0.0)
    assert field_views(ball) == module.FieldViews(None, None, None)

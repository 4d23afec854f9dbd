"""A mesh file as a target: its faces are turned as an upload's are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import trimesh

from regnf_fit.mesh import mesh_target

TOP = trimesh.creation.box(bounds=[[-1.0, -1.0, 0.8], [1.0, 1.0, 1.0]])
LEG = trimesh.creation.box(bounds=[[-0.2, -0.2, -1.0], [0.2, 0.2, 0.7]])


def written(folder: Path, *meshes: trimesh.Trimesh) -> Path:
    path = folder / "table.ply"
    trimesh.util.concatenate([mesh.copy() for mesh in meshes]).export(path)
    return path


def test_a_part_that_is_inside_out_is_matter(tmp_path: Path) -> None:
    leg = LEG.copy()
    leg.invert()
    found = mesh_target(written(tmp_path, TOP, leg), extent=1.0)
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.45], [0.3, 0.3, 0.0]])
    np.testing.assert_allclose(found.field.signed_distance(places), [-0.1, -0.05, 0.2 * 2**0.5], atol=1e-6)
    assert any("turned round" in done for done in found.source["mesh_faces"])


def test_nothing_is_said_of_faces_that_stay(tmp_path: Path) -> None:
    assert mesh_target(written(tmp_path, TOP, LEG)).source == {"mesh": "table.ply"}

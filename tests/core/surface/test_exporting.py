"""Fields as files of other programs, and back through the gate's readers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import InvalidInputError
from regnf_core.fields.mesh import MeshField
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.meshes.ply import read_ply
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.surface.exporting import write_grid, write_mesh
from tests.core.surface.test_isosurface import Formula, ball


@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_a_mesh_comes_back(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"ball.{kind}"
    counts: list[int] = []
    triangles = write_mesh(Formula(ball), path, 40, counts.append)
    assert counts
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    ours = convert_mesh(kind, memoryview(path.read_bytes()), UploadDescription())
    assert ours.why[1] == "watertight"
    assert 0.95 * triangles < len(ours.tensors["faces"]) <= triangles  # some that touch a node have no area
    field = MeshField(ours.tensors["vertices"], ours.tensors["faces"])
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    torch.testing.assert_close(field.signed_distance(points), ball(points), rtol=0, atol=2e-3)
    if kind == "ply":  # towards free space
        stored = read_ply(memoryview(path.read_bytes()))
        assert stored.normals is not None
        np.testing.assert_allclose(stored.normals, 2.0 * stored.vertices, atol=5e-3)
    else:
        assert b'"NORMAL"' in path.read_bytes()


def test_a_grid_holds_the_field_s_values(tmp_path: Path) -> None:
    bounds = torch.tensor([[-1.0, -0.5, -0.7], [1.0, 0.6, 0.7]], dtype=torch.float64)
    field = Formula(lambda points: points @ torch.tensor([1.0, 10.0, 100.0]).to(points), bounds)
    shape = write_grid(field, tmp_path / "grid.npz", 20)
    grid = np.load(tmp_path / "grid.npz", allow_pickle=False)
    assert shape == grid["sdf"].shape == (21, 12, 15)
    assert grid["sdf"].dtype == np.float32
    i, j, k = 3, 5, 7
    place = grid["origin"] + grid["spacing"] * (i, j, k)
    assert grid["sdf"][i, j, k] == pytest.approx(place @ [1.0, 10.0, 100.0], rel=1e-5)
    np.testing.assert_allclose(grid["origin"], [-1.0, -0.5, -0.7])
    np.testing.assert_allclose(grid["spacing"], 0.1)


def test_what_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "ball.glb"
    path.write_bytes(b"before")
    broken = Formula(lambda points: points[:, 0] * torch.nan)
    for write, target in ((write_mesh, path), (write_grid, tmp_path / "ball.npz")):
        with pytest.raises(InvalidInputError):
            write(broken, target, 8)
    with pytest.raises(InvalidInputError):
        write_mesh(Formula(ball), tmp_path / "ball.stl")
    with pytest.raises(InvalidInputError):
        write_grid(Formula(ball), tmp_path / "ball.npz", 1024)
    assert path.read_bytes() == b"before"
    assert [entry.name for entry in tmp_path.iterdir()] == ["ball.glb"]

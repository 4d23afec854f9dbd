"""Surfaces of fields as meshes: against formulas, and closed wherever the field's surface is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import CountingField
from regnf_core.importing.families.mesh import convert_mesh
from regnf_core.importing.meshes.ply import read_ply
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.surface.exporting import write_grid, write_mesh
from regnf_core.surface.isosurface import Lattice, Surface, extract_surface
from tests.core.analytic import AnalyticField

CUBE = [[-1.0] * 3, [1.0] * 3]


def field_of(distance: Callable[[Tensor], Tensor], bounds: Sequence[Sequence[float]] = CUBE) -> AnalyticField:
    return AnalyticField(distance, bounds)


def ball(points: Tensor) -> Tensor:
    return points.norm(dim=1) - 0.5


def mesh_of(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.mark.parametrize("resolution", [20, 64])
def test_a_sphere(resolution: int) -> None:
    """At 64 some nodes lie exactly on the surface."""
    surface = extract_surface(field_of(ball), resolution)
    mesh = mesh_of(surface)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=15.0 / resolution**2)  # positive: faces outward
    # between two nodes a step h apart a distance of curvature 2 bends away from its chord by at most h^2 / 4
    assert np.abs(np.linalg.norm(surface.vertices, axis=1) - 0.5).max() < (2.0 / resolution) ** 2 / 4
    np.testing.assert_allclose(
        surface.normals, surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None], atol=1e-4
    )


def test_a_field_steeper_than_it_should_be_in_one_place_loses_nothing() -> None:
    """A small thing whose values change eight times as fast as a distance does: probes hardly meet it."""

    def distance(points: Tensor) -> Tensor:
        small = (points - torch.tensor([0.7, 0.7, 0.7])).norm(dim=1) - 0.06
        return torch.where(small < 0.1, torch.minimum(8 * small, ball(points)), ball(points))

    mesh = mesh_of(extract_surface(field_of(distance), 64))
    parts = mesh.split()
    assert len(parts) == 2
    assert all(part.is_watertight for part in parts)


def test_a_surface_ends_at_the_bounds() -> None:
    surface = extract_surface(field_of(lambda points: points[:, 2] - 0.1), 16)
    np.testing.assert_allclose(surface.vertices[:, 2], 0.1, atol=1e-6)
    assert mesh_of(surface).area == pytest.approx(4.0, rel=1e-6)
    np.testing.assert_allclose(surface.normals, np.tile([0.0, 0.0, 1.0], (len(surface.normals), 1)), atol=1e-6)


def test_most_of_the_region_is_never_asked_for() -> None:
    field = CountingField(field_of(ball))
    counts: list[int] = []
    extract_surface(field, 128, counts.append)
    assert field.evaluations < 0.2 * 128**3
    assert counts[-1] == field.evaluations


def test_cells_are_cubes_whatever_the_bounds() -> None:
    bounds = [[-1.0, -0.55, -0.6], [1.0, 0.55, 0.6]]
    field = field_of(ball, bounds)
    lattice = Lattice.over(field, 100)
    assert (lattice.counts.tolist(), lattice.step) == ([101, 56, 61], 0.02)
    assert mesh_of(extract_surface(field, 100)).is_watertight


@pytest.mark.parametrize(
    ("distance", "resolution", "error"),
    [
        (lambda points: points.norm(dim=1) + 1.0, 32, NoSurfaceError),
        (lambda points: torch.where(points[:, 0] > 0.5, torch.nan, ball(points)), 32, InvalidInputError),
        (ball, 1, InvalidInputError),
        (ball, 1025, InvalidInputError),
    ],
)
def test_what_has_no_surface(distance: Callable[[Tensor], Tensor], resolution: int, error: type[Exception]) -> None:
    with pytest.raises(error):
        extract_surface(field_of(distance), resolution)


# Fields as files of other programs, and back through the gate's readers.


@pytest.mark.parametrize("kind", ["glb", "ply"])
def test_a_mesh_comes_back(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"ball.{kind}"
    counts: list[int] = []
    triangles = write_mesh(field_of(ball), path, 40, counts.append)
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
    bounds = [[-1.0, -0.5, -0.7], [1.0, 0.6, 0.7]]
    field = field_of(lambda points: points @ torch.tensor([1.0, 10.0, 100.0]).to(points), bounds)
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
    broken = field_of(lambda points: points[:, 0] * torch.nan)
    for write, target in ((write_mesh, path), (write_grid, tmp_path / "ball.npz")):
        with pytest.raises(InvalidInputError):
            write(broken, target, 8)
    with pytest.raises(InvalidInputError):
        write_mesh(field_of(ball), tmp_path / "ball.stl")
    with pytest.raises(InvalidInputError):
        write_grid(field_of(ball), tmp_path / "ball.npz", 1024)
    assert path.read_bytes() == b"before"
    assert [entry.name for entry in tmp_path.iterdir()] == ["ball.glb"]

"""A tiny fit to a ball, from exact distances to a file that opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.solids import BoxField
from regnf_core.errors import CancelledError, InvalidInputError
from regnf_core.fields.build import open_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.safe_format import read_description
from regnf_fit.mesh import fit_field, mesh_target
from regnf_fit.network import StartShape, TrainableField
from regnf_fit.options import FitOptions
from tests.core.analytic import AnalyticField, sphere

OPTIONS = FitOptions(
    grid=HashGridConfig.from_top_resolution(64, levels=4, log2_table_size=10),
    hidden_width=32,
    iterations=200,
    batch=1024,
    gradient_batch=512,
    near_points=20_000,
    volume_points=5_000,
)


def ball() -> AnalyticField:
    return sphere(0.4, bounds=[[-0.4] * 3, [0.4] * 3])


def test_a_ball(tmp_path: Path) -> None:
    path = tmp_path / "ball.safetensors"
    seen: list[int] = []
    report = fit_field(
        ball(), path, OPTIONS, seed=1, label="ball", progress=lambda iteration, loss, left: seen.append(iteration)
    )
    assert seen == [50, 100, 150, 200]
    assert report.mean_error < 0.004
    assert report.volume_mean_error < 0.01
    assert report.mean_normal_cosine > 0.98
    assert report.mean_gradient_norm == pytest.approx(1.0, abs=0.05)
    assert report.diagonal == pytest.approx(0.8 * 3**0.5)
    assert read_description(path)["label"] == "ball"
    field = open_field(path)
    points = torch.tensor([[0.0, 0.4, 0.0], [0.3, 0.0, 0.3], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(field.signed_distance(points[:2]), torch.tensor([0.0, 0.0243]), rtol=0, atol=0.01)
    assert field.signed_distance(points)[2] < -0.2


def test_same_seed_same_field(tmp_path: Path) -> None:
    few = FitOptions(**(vars(OPTIONS) | {"iterations": 5}))
    for name in ("a", "b"):
        fit_field(BoxField((-0.3, -0.3, -0.3), (0.3, 0.2, 0.4)), tmp_path / name, few, seed=3)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_starts_as_a_signed_distance() -> None:
    # Geometric initialization nears |x| - radius as the layers widen.
    wide = FitOptions(**(vars(OPTIONS) | {"hidden_width": 1024}))
    network = TrainableField(wide, StartShape(torch.zeros(3), 0.5), torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(1)))
    with torch.no_grad():
        outside = network.function().value(1.5 * directions)
        inside = network.function().value(0.1 * directions)
    torch.testing.assert_close(outside, torch.ones(200), rtol=0, atol=0.25)
    assert (inside < 0).all()


def test_progress_may_stop_the_fit(tmp_path: Path) -> None:
    def stop(iteration: int, loss: float, seconds_left: float) -> None:
        raise CancelledError("enough")

    with pytest.raises(CancelledError):
        fit_field(ball(), tmp_path / "ball", OPTIONS, progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        (AnalyticField(lambda points: 1.0 + 0.0 * points.sum(-1), [[-0.5] * 3, [0.5] * 3]), "NO_SURFACE_IN_TARGET"),
        (MeshField(np.zeros((3, 3)), [[0, 1, 2]]), "NO_SURFACE_IN_TARGET"),
    ],
)
def test_targets_that_cannot_be_fitted(target: SdfField, reason: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError) as caught:
        fit_field(target, tmp_path / "field", OPTIONS)
    assert caught.value.reason == reason


@pytest.mark.parametrize("target", ["function", "mesh"])
def test_a_target_that_is_large_and_far_away_is_fitted_where_it_lies(target: str, tmp_path: Path) -> None:
    shift = torch.tensor([448_262.25, 5_413_920.5, 112.0], dtype=torch.float64)
    large: SdfField = sphere(3.0, bounds=[[-3.0] * 3, [3.0] * 3])
    if target == "mesh":
        round_mesh = trimesh.creation.icosphere(3, radius=3.0)
        large = MeshField(round_mesh.vertices, round_mesh.faces)
    placed = TransformedField(large, Sim3.from_translation(-shift))
    report = fit_field(placed, tmp_path / "field", OPTIONS, seed=1)
    assert report.diagonal == pytest.approx(6.0 * 3**0.5, rel=1e-3)
    assert report.mean_error < 0.004
    assert report.mean_normal_cosine > 0.98
    field = open_field(tmp_path / "field")
    torch.testing.assert_close(field.bounds.mean(0), shift, rtol=0, atol=0.01)
    points = torch.tensor([[0.0, 3.0, 0.0], [2.0, 0.0, 2.0], [-3.0, 0.0, 0.0]]).double() + shift
    torch.testing.assert_close(field.signed_distance(points), torch.tensor([0.0, -0.17, 0.0]), rtol=0, atol=0.08)


# A mesh file as the target of a fit.

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
    assert any("flipped" in done for done in found.source["mesh_faces"])


def test_nothing_is_said_of_faces_that_stay(tmp_path: Path) -> None:
    assert mesh_target(written(tmp_path, TOP, LEG)).source == {"mesh": "table.ply"}

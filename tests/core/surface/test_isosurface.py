"""Surfaces of fields as meshes: against formulas, and closed wherever the field's surface is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.fields.observation import CountingField
from regnf_core.surface.isosurface import Lattice, Surface, extract_surface


@dataclass(frozen=True)
class Formula:
    """A field by formula over the cube from -1 to 1, gradient by autograd."""

    distance: Callable[[Tensor], Tensor]
    bounds: Tensor = torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=torch.float64)  # noqa: RUF009

    device = torch.device("cpu")

    def to(self, device: torch.device | str) -> Formula:
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.distance(points)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            leaf = points.detach().requires_grad_()
            distance = self.distance(leaf)
            (gradient,) = torch.autograd.grad(distance.sum(), leaf)
        return distance.detach(), gradient


def ball(points: Tensor) -> Tensor:
    return points.norm(dim=1) - 0.5


def mesh_of(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.mark.parametrize("resolution", [20, 64])
def test_a_sphere(resolution: int) -> None:
    """At 64 some nodes lie exactly on the surface."""
    surface = extract_surface(Formula(ball), resolution)
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

    mesh = mesh_of(extract_surface(Formula(distance), 64))
    parts = mesh.split()
    assert len(parts) == 2
    assert all(part.is_watertight for part in parts)


def test_a_surface_ends_at_the_bounds() -> None:
    surface = extract_surface(Formula(lambda points: points[:, 2] - 0.1), 16)
    np.testing.assert_allclose(surface.vertices[:, 2], 0.1, atol=1e-6)
    assert mesh_of(surface).area == pytest.approx(4.0, rel=1e-6)
    np.testing.assert_allclose(surface.normals, np.tile([0.0, 0.0, 1.0], (len(surface.normals), 1)), atol=1e-6)


def test_most_of_the_region_is_never_asked_for() -> None:
    field = CountingField(Formula(ball))
    counts: list[int] = []
    extract_surface(field, 128, counts.append)
    assert field.evaluations < 0.2 * 128**3
    assert counts[-1] == field.evaluations


def test_cells_are_cubes_whatever_the_bounds() -> None:
    bounds = torch.tensor([[-1.0, -0.55, -0.6], [1.0, 0.55, 0.6]], dtype=torch.float64)
    field = Formula(ball, bounds)
    lattice = Lattice.over(field, 100)
    assert (lattice.counts.tolist(), lattice.step) == ([101, 56, 61], 0.02)
    assert mesh_of(extract_surface(field, 100)).is_watertight


@pytest.mark.parametrize(
    ("distance", "error"),
    [
        (lambda points: points.norm(dim=1) + 1.0, NoSurfaceError),
        (lambda points: torch.where(points[:, 0] > 0.5, torch.nan, ball(points)), InvalidInputError),
    ],
)
def test_what_has_no_surface(distance: Callable[[Tensor], Tensor], error: type[Exception]) -> None:
    with pytest.raises(error):
        extract_surface(Formula(distance), 32)


@pytest.mark.parametrize("resolution", [1, 1025])
def test_resolutions_out_of_range(resolution: int) -> None:
    with pytest.raises(InvalidInputError):
        extract_surface(Formula(ball), resolution)

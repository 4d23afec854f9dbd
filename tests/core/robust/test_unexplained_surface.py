"""Surface joined to an object, told from that of things close by: a table top, and slabs on it or above it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.residuals import SurfacePair
from regnf_core.robust.verdict.evidence import unexplained_samples
from regnf_core.robust.working_frame import Samples

UP = torch.tensor([0.0, 0.0, 1.0])


class Floor:
    """Matter below ``height``; above x = 5 below ``right``."""

    def __init__(self, height: float, right: float) -> None:
        self.height, self.right = height, right

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        top = torch.where(points[:, 0] > 5.0, self.right, self.height)
        return points[:, 2] - top, UP.expand_as(points)


def samples(*rows: tuple[float, float, float]) -> Samples:
    """(x, height, whether it faces up or down) each."""
    points = torch.tensor([[x, 0.0, z] for x, z, _ in rows])
    normals = torch.stack([UP * facing for _, _, facing in rows])
    return Samples(points, torch.zeros(len(rows)), normals)


def share(A: Samples, right: float, T: Sim3 | None = None) -> float:
    """Of the samples near the plane z = 0 as object, in a scene whose matter reaches to ``right`` above x = 5."""
    surfaces = SurfacePair(Floor(0.0, right), Floor(0.0, 0.0), A, A)
    return share_of(surfaces, (Sim3.identity() if T is None else T)[None])


def share_of(surfaces: SurfacePair, T: Sim3) -> float:
    heights = T[0].apply(surfaces.scene_samples.points)[:, 2]
    near = heights.abs() <= 0.1
    found = unexplained_samples(surfaces, T, (near & (heights > 0.03))[None])[0]
    assert not bool((found & ~near).any())
    return float(found.sum() / near.sum().clamp_min(1))


def test_what_lies_on_the_object_is_unexplained() -> None:
    A = samples(*[(float(x), 0.0, 1.0) for x in range(5)], (6.0, 0.06, 1.0), (7.0, 0.06, 1.0), (8.0, 0.5, 1.0))
    assert share(A, 0.06) == pytest.approx(2 / 7)  # the last is too far off to be near


def test_what_faces_the_object_across_a_gap_is_not() -> None:
    A = samples(*[(float(x), 0.0, 1.0) for x in range(8)], (6.0, 0.06, -1.0), (7.0, 0.06, -1.0))
    assert share(A, 0.0) == 0.0
    assert share(A, 0.06) == pytest.approx(0.2)  # the same, but what it faces is not there


def test_only_what_is_asked_about_is_unexplained() -> None:
    A = samples((0.0, 0.029, 1.0), (1.0, -0.06, 1.0), (2.0, 0.031, 1.0))
    assert share(A, 0.0) == pytest.approx(1 / 3)


def test_it_is_the_same_in_every_frame() -> None:
    A = samples(*[(float(x), 0.0, 1.0) for x in range(5)], (6.0, 0.06, 1.0))
    T = Sim3.from_quaternion(2.0, [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    half = Samples(A.points / 2.0, A.values, A.normals)

    class Halved(Floor):
        def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = super().value_and_gradient(2.0 * points)
            return value / 2.0, gradient

    surfaces = SurfacePair(Halved(0.0, 0.06), Floor(0.0, 0.0), half, half)
    found = share_of(surfaces, T[None])
    assert found == pytest.approx(1 / 6)
    assert share(A, 0.06) == pytest.approx(1 / 6)


def test_nothing_near_is_no_share() -> None:
    assert share(samples((0.0, 3.0, 1.0)), 0.0) == 0.0

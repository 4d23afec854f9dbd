from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from regnf_core.importing.gate.plausibility import check_plausibility
from tests.core.importing.archives import assert_refused


class _Field:
    """A field given by a formula, differentiated by autograd."""

    device = torch.device("cpu")

    def __init__(self, formula: Callable[[Tensor], Tensor], half: float = 1.0) -> None:
        self.formula = formula
        self.bounds = torch.tensor([[-half] * 3, [half] * 3], dtype=torch.float64)

    def to(self, device: torch.device | str) -> _Field:
        return self

    def signed_distance(self, points: Tensor) -> Tensor:
        return self.formula(points)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        points = points.detach().requires_grad_(True)
        distance = self.formula(points)
        if not distance.requires_grad:
            return distance, torch.zeros_like(points)
        (gradient,) = torch.autograd.grad(distance.sum(), points)
        return distance.detach(), gradient


def sphere(radius: float, factor: float = 1.0) -> _Field:
    return _Field(lambda points: factor * (points.norm(dim=-1) - radius))


def test_a_sphere_is_plausible() -> None:
    """Share inside by hand: 4/3 pi 0.5^3 of the cube's 8. The surface is smaller than the bounds."""
    figures, warnings, (low, high) = check_plausibility(sphere(0.5))
    assert warnings == []
    assert figures["share_inside"] == pytest.approx(0.0654, abs=0.006)
    assert figures["share_inside_at_bounds"] == 0.0
    assert [figures[f"gradient_{q}"] for q in ("p10", "median", "p90")] == pytest.approx([1, 1, 1], abs=1e-4)
    assert [*low, *high] == pytest.approx([-0.5] * 3 + [0.5] * 3, abs=0.01)


def test_the_faces_count_alike_whatever_their_size() -> None:
    """A half space that ends at x = 0: one face inside, one outside, half of each of the other four."""
    field = _Field(lambda points: points[:, 0])
    field.bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 9.0, 1.0]], dtype=torch.float64)
    assert check_plausibility(field)[0]["share_inside_at_bounds"] == pytest.approx(0.5, abs=0.03)


def test_a_surface_too_small_for_the_samples_is_found_by_walking() -> None:
    figures, _, _ = check_plausibility(sphere(0.01))
    assert figures["share_inside"] < 1e-3
    assert figures["surface_points"] > 100


@pytest.mark.parametrize(
    ("factor", "word"), [(0.2, "GRADIENT_NOT_UNIT"), (5.0, "GRADIENT_NOT_UNIT"), (-1.0, "MOSTLY_INSIDE")]
)
def test_a_gradient_far_from_one_and_a_swapped_sign_are_warned_of(factor: float, word: str) -> None:
    figures, warnings, _ = check_plausibility(sphere(0.5, factor))
    assert figures["gradient_median"] == pytest.approx(abs(factor), rel=1e-3)
    assert [w.split(":")[0] for w in warnings] == [word]


@pytest.mark.parametrize(
    ("formula", "reason"),
    [
        *((lambda p, c=c: torch.full((p.shape[0],), c), "NO_ZERO_LEVEL") for c in (0.0, 1.0, -1.0, 1e-6)),
        (lambda p: p.norm(dim=-1) + 0.1, "NO_ZERO_LEVEL"),  # it only touches zero
        (lambda p: p[:, 0] / 0.0, "FIELD_NOT_FINITE"),
        (lambda p: p[:, 0].abs().sqrt().sqrt() * torch.nan, "FIELD_NOT_FINITE"),
        (sphere(0.5, 1e25).formula, "FIELD_NOT_FINITE"),  # each part of a gradient is a number, its square is not
    ],
)
def test_what_is_no_distance_is_refused(formula: Callable[[Tensor], Tensor], reason: str) -> None:
    assert_refused(lambda: check_plausibility(_Field(formula)), reason)

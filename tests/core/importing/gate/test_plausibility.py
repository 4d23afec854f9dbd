from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.importing.gate.plausibility import check_plausibility


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


def reason_of(field: _Field) -> str:
    with pytest.raises(FieldFormatError) as caught:
        check_plausibility(field)
    return caught.value.reason


def test_a_sphere_is_plausible() -> None:
    """Share inside by hand: 4/3 pi 0.5^3 of the cube's 8."""
    figures, warnings, _ = check_plausibility(sphere(0.5))
    assert warnings == []
    assert figures["share_inside"] == pytest.approx(0.0654, abs=0.006)
    assert figures["share_inside_at_bounds"] == 0.0
    assert [figures[f"gradient_{q}"] for q in ("p10", "median", "p90")] == pytest.approx([1, 1, 1], abs=1e-4)


def test_the_faces_count_alike_whatever_their_size() -> None:
    """A half space that ends at x = 0: one face inside, one outside, half of each of the other four."""
    field = _Field(lambda points: points[:, 0])
    field.bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 9.0, 1.0]], dtype=torch.float64)
    assert check_plausibility(field)[0]["share_inside_at_bounds"] == pytest.approx(0.5, abs=0.03)


def test_a_surface_too_small_for_the_samples_is_found_by_walking() -> None:
    figures, _, _ = check_plausibility(sphere(0.01))
    assert figures["share_inside"] < 1e-3
    assert figures["surface_points"] > 100


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_gradient_far_from_one_is_warned_of(factor: float) -> None:
    figures, warnings, _ = check_plausibility(sphere(0.5, factor))
    assert figures["gradient_median"] == pytest.approx(factor, rel=1e-3)
    assert [w.split(":")[0] for w in warnings] == ["GRADIENT_NOT_UNIT"]


def test_a_swapped_sign_is_warned_of() -> None:
    assert [w.split(":")[0] for w in check_plausibility(sphere(0.5, -1.0))[1]] == ["MOSTLY_INSIDE"]


@pytest.mark.parametrize("constant", [0.0, 1.0, -1.0, 1e-6])
def test_a_constant_field_has_no_surface(constant: float) -> None:
    assert reason_of(_Field(lambda points: torch.full((points.shape[0],), constant))) == "NO_ZERO_LEVEL"


def test_a_surface_outside_the_bounds_does_not_count() -> None:
    assert reason_of(_Field(lambda points: points[:, 0] - 3.0)) == "NO_ZERO_LEVEL"


def test_a_field_that_only_touches_zero_has_no_surface() -> None:
    assert reason_of(_Field(lambda points: points.norm(dim=-1) + 0.1)) == "NO_ZERO_LEVEL"


def test_numbers_that_are_not_finite_are_refused() -> None:
    assert reason_of(_Field(lambda points: points[:, 0] / 0.0)) == "FIELD_NOT_FINITE"
    assert reason_of(_Field(lambda points: points[:, 0].abs().sqrt().sqrt() * torch.nan)) == "FIELD_NOT_FINITE"


def test_gradients_whose_norm_overflows_are_refused() -> None:
    """Each part is a number, its square is not."""
    assert reason_of(sphere(0.5, 1e25)) == "FIELD_NOT_FINITE"


def test_the_surface_is_smaller_than_the_bounds() -> None:
    _, _, (low, high) = check_plausibility(sphere(0.5))
    assert low == pytest.approx([-0.5] * 3, abs=0.01)
    assert high == pytest.approx([0.5] * 3, abs=0.01)

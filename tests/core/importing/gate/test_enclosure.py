"""Rooms, things turned inside out, and fields that have no surface but at their bounds, by formulas."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.importing.gate.plausibility import check_plausibility, require_plausible
from tests.core.importing.gate.test_plausibility import _Field, sphere


def box(points: Tensor, half: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)) -> Tensor:
    """The signed distance to a box."""
    q = (points - torch.tensor(center, dtype=points.dtype)).abs() - torch.tensor(half, dtype=points.dtype)
    return q.clamp_min(0).norm(dim=-1) + q.amax(dim=-1).clamp_max(0)


def chair(points: Tensor) -> Tensor:
    legs = [box(points, (0.05, 0.05, 0.25), (x, y, -0.35)) for x in (-0.3, 0.3) for y in (-0.3, 0.3)]
    parts = [box(points, (0.35, 0.35, 0.05), (0, 0, -0.05)), box(points, (0.35, 0.05, 0.35), (0, 0.3, 0.3)), *legs]
    return torch.stack(parts).amin(dim=0)


def turned(points: Tensor) -> Tensor:
    """By 40 degrees about the vertical axis."""
    c, s = math.cos(0.7), math.sin(0.7)
    return points @ torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=points.dtype)


def room(points: Tensor) -> Tensor:
    """Solid all round, a chair and a cupboard within."""
    inside = -box(points, (0.9, 0.7, 0.6))
    things = torch.minimum(chair(points), box(points, (0.15, 0.3, 0.5), (0.75, 0.3, -0.1)))
    return torch.minimum(inside, things)


def bent_room(points: Tensor) -> Tensor:
    """An L of two arms."""
    arms = torch.minimum(box(points, (0.9, 0.35, 0.4), (0, -0.5, 0)), box(points, (0.35, 0.9, 0.4), (-0.5, 0, 0)))
    return torch.minimum(-arms, box(points, (0.15, 0.15, 0.1), (0.5, -0.5, -0.3)))


def shell(points: Tensor) -> Tensor:
    """Thin walls, free space within and without."""
    return torch.minimum(box(points, (0.8, 0.8, 0.7)).abs() - 0.03, chair(points))


def judged(field: _Field, sign: int | None = 1) -> str | None:
    """None, or what is said against it."""
    measured, _, _ = check_plausibility(field)
    try:
        require_plausible(measured, sign)
    except FieldFormatError as error:
        return f"{error.reason} {error}"
    return None


@pytest.mark.parametrize(
    "formula",
    [room, bent_room, shell, chair, lambda p: room(turned(p)), lambda p: bent_room(turned(p)), lambda p: p[:, 2] + 0.7],
    ids=["room", "bent", "shell", "chair", "turned", "bent and turned", "ground"],
)
def test_rooms_and_things_are_sound(formula: object) -> None:
    assert judged(_Field(formula)) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("formula", [chair, shell, lambda p: chair(turned(p)), lambda p: p.norm(dim=-1) - 0.5])
def test_a_thing_turned_inside_out_is_refused(formula: object, sign: int) -> None:
    field = _Field(lambda points: -formula(points))  # type: ignore[operator]
    said = judged(field, sign)
    assert said is not None
    assert said.startswith("FIELD_IMPLAUSIBLE")
    assert "inside out" in said
    assert f"say sign {-sign} to turn it round" in said
    assert judged(field, None) is None


def test_a_frame_at_the_bounds_is_a_thing() -> None:
    """Four thin bars, nowhere in the middle, with free space all round."""

    def frame(points: Tensor) -> Tensor:
        return torch.stack(
            [
                *(box(points, (0.97, 0.02, 0.9), (0, y, 0)) for y in (-0.96, 0.96)),
                *(box(points, (0.02, 0.97, 0.9), (x, 0, 0)) for x in (-0.96, 0.96)),
            ]
        ).amin(dim=0)

    assert judged(_Field(frame)) is None


def test_a_surface_at_the_bounds_only_is_refused() -> None:
    """An empty room that its bounds cut just behind the walls: nothing is in it that could be found."""
    empty = _Field(lambda points: -box(points, (0.98, 0.98, 0.98)))
    said = judged(empty, None)
    assert said is not None
    assert "at its bounds only" in said
    small = _Field(
        lambda points: torch.minimum(empty.formula(points), box(points, (0.05, 0.05, 0.05), (0.3, 0.2, -0.5)))
    )
    assert judged(small) is None


def test_where_all_is_inside_but_the_corners_it_is_refused() -> None:
    field = _Field(lambda points: points.norm(dim=-1) - 1.65)
    said = judged(field, None)
    assert said is not None
    assert "everything is inside" in said


def test_a_solid_that_fills_its_bounds_is_a_thing() -> None:
    assert judged(_Field(lambda points: box(points, (0.98, 0.98, 0.98)))) is None


def test_a_flat_surface_has_no_hull() -> None:
    assert judged(_Field(lambda points: points[:, 2])) is None


def test_no_surface_says_what_there_is() -> None:
    with pytest.raises(FieldFormatError) as caught:
        check_plausibility(_Field(lambda points: points[:, 0] - 3.0))
    assert caught.value.reason == "NO_ZERO_LEVEL"
    assert "all is inside matter, with values from -4 to -2" in str(caught.value)
    with pytest.raises(FieldFormatError, match="all is free"):
        check_plausibility(sphere(-0.1))

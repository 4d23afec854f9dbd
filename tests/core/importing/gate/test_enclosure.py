"""Rooms, things turned inside out, and fields that have no surface but at their bounds, by formulas."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.importing.gate.plausibility import check_plausibility, require_plausible
from tests.core.importing.gate.test_plausibility import _Field, sphere

Formula = Callable[[Tensor], Tensor]


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


def frame(points: Tensor) -> Tensor:
    """Four thin bars at the bounds, nothing in the middle, free space all round."""
    bars = [box(points, (0.97, 0.02, 0.9), (0, y, 0)) for y in (-0.96, 0.96)]
    bars += [box(points, (0.02, 0.97, 0.9), (x, 0, 0)) for x in (-0.96, 0.96)]
    return torch.stack(bars).amin(dim=0)


def empty_room(points: Tensor) -> Tensor:
    """Its bounds cut it just behind the walls."""
    return -box(points, (0.98, 0.98, 0.98))


def judged(formula: Formula, *signs: int | None) -> list[str | None]:
    """For each sign that may be said: None, or what is said against it."""
    measured, _, _ = check_plausibility(_Field(formula))
    said: list[str | None] = []
    for sign in signs:
        try:
            require_plausible(measured, sign)
            said.append(None)
        except FieldFormatError as error:
            said.append(f"{error.reason} {error}")
    return said


SOUND: dict[str, Formula] = {
    "room": room,
    "bent": bent_room,
    "shell": shell,
    "chair": chair,
    "turned": lambda p: room(turned(p)),
    "bent and turned": lambda p: bent_room(turned(p)),
    "ground": lambda p: p[:, 2] + 0.7,
    "plane": lambda p: p[:, 2],  # has no hull
    "frame": frame,
    "a solid that fills its bounds": lambda p: box(p, (0.98, 0.98, 0.98)),
    "a small thing in a room": lambda p: torch.minimum(empty_room(p), box(p, (0.05, 0.05, 0.05), (0.3, 0.2, -0.5))),
}


@pytest.mark.parametrize("name", SOUND)
def test_rooms_and_things_are_sound(name: str) -> None:
    assert judged(SOUND[name], 1) == [None]


@pytest.mark.parametrize("formula", [chair, shell, lambda p: chair(turned(p)), lambda p: p.norm(dim=-1) - 0.5])
def test_a_thing_turned_inside_out_is_refused(formula: Formula) -> None:
    *refused, accepted = judged(lambda points: -formula(points), 1, -1, None)
    for said, other in zip(refused, (-1, 1), strict=True):
        assert said is not None
        assert said.startswith("FIELD_IMPLAUSIBLE")
        assert "inside out" in said
        assert f"sign: {other} to invert it" in said
    assert accepted is None


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        (empty_room, "only at its bounds"),
        (lambda points: points.norm(dim=-1) - 1.65, "everything except places at the bounds is inside"),
    ],
)
def test_where_nothing_could_be_found_it_is_refused(formula: Formula, words: str) -> None:
    """The second: all but the corners."""
    (said,) = judged(formula, None)
    assert said is not None
    assert words in said


def test_no_surface_says_what_there_is() -> None:
    for field, words in (
        (_Field(lambda points: points[:, 0] - 3.0), "all is inside matter, with values from -4 to -2"),
        (sphere(-0.1), "all is free"),
    ):
        with pytest.raises(FieldFormatError, match=words) as caught:
            check_plausibility(field)
        assert caught.value.reason == "NO_ZERO_LEVEL"

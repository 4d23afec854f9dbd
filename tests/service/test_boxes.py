"""Boxes as plain numbers, by hand-computed cases and a slow reference."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from regnf_service.jobs.boxes import boxes_overlap, normal_quaternion, rotation_columns

HALF = math.sqrt(0.5)


def test_a_quarter_turn_about_z() -> None:
    columns = rotation_columns((0.0, 0.0, HALF, HALF))
    expected = ((0, 1, 0), (-1, 0, 0), (0, 0, 1))
    for column, wanted in zip(columns, expected, strict=True):
        assert column == pytest.approx(wanted)


@pytest.mark.parametrize("factor", [1.0, -1.0, 7.5, -1e-3])
def test_every_multiple_of_a_quaternion_is_one(factor: float) -> None:
    q = (0.1, -0.2, 0.3, 0.5)
    assert normal_quaternion([factor * value for value in q]) == normal_quaternion(q)


def test_half_turns_have_one_spelling_too() -> None:
    assert normal_quaternion((0, 0, -1, 0)) == normal_quaternion((0, 0, 1, 0)) == (0.0, 0.0, 1.0, 0.0)
    assert normal_quaternion((-1, 0, 0, 0)) == (1.0, 0.0, 0.0, 0.0)


def test_no_negative_zero() -> None:
    assert str(normal_quaternion((-0.0, 0.0, -0.0, 2.0))) == "(0.0, 0.0, 0.0, 1.0)"


@pytest.mark.parametrize(
    ("center", "size", "xyzw", "overlap"),
    [
        ((0, 0, 0), (1, 1, 1), (0, 0, 0, 1), True),
        ((1.4, 0, 0), (1, 1, 1), (0, 0, 0, 1), True),
        ((1.6, 0, 0), (1, 1, 1), (0, 0, 0, 1), False),
        # turned by 45 degrees about z its half width is sqrt(1/2) = 0.707
        ((1.7, 0, 0), (1, 1, 1), (0, 0, 0.38268343, 0.92387953), True),
        ((1.71, 0, 0), (1, 1, 1), (0, 0, 0.38268343, 0.92387953), False),
        # its flat side faces the corner (1, 1): only its own axis separates
        ((1.3, 1.3, 0), (1, 1, 1), (0, 0, 0.38268343, 0.92387953), True),
        ((1.4, 1.4, 0), (1, 1, 1), (0, 0, 0.38268343, 0.92387953), False),
        ((0, 0, 0), (100, 100, 100), (0, 0, 0, 1), True),
        ((0, 0, 0), (1e-9, 1e-9, 1e-9), (0, 0, 0, 1), True),
    ],
)
def test_overlap_with_the_cube_of_edge_two(
    center: tuple[float, ...], size: tuple[float, ...], xyzw: tuple[float, ...], overlap: bool
) -> None:
    assert boxes_overlap(center, size, xyzw, (-1, -1, -1), (1, 1, 1)) is overlap


def test_no_box_with_a_point_inside_is_called_outside() -> None:
    """The slow way: a grid of points in the box; any of them in the bounds proves an overlap."""
    rng = random.Random(0)
    proved = 0
    for _ in range(300):
        center = [rng.uniform(-2.5, 2.5) for _ in range(3)]
        size = [rng.uniform(0.1, 3) for _ in range(3)]
        xyzw = normal_quaternion([rng.gauss(0, 1) for _ in range(4)])
        columns = rotation_columns(xyzw)
        steps = [-0.5, -0.25, 0.0, 0.25, 0.5]
        inside = any(
            all(
                abs(center[axis] + sum(f * size[i] * columns[i][axis] for i, f in enumerate(fractions))) <= 1
                for axis in range(3)
            )
            for fractions in itertools.product(steps, repeat=3)
        )
        proved += inside
        if inside:
            assert boxes_overlap(center, size, xyzw, (-1, -1, -1), (1, 1, 1))
    assert 50 < proved < 290

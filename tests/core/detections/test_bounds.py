"""Boxes as plain numbers, by hand-computed cases and a slow reference."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from regnf_core.detections import Detection, require_in_scene
from regnf_core.detections.bounds import distance
from regnf_core.errors import InvalidDetectionError
from regnf_core.rotations import Vector, normal_quaternion, rotation_columns

HALF = math.sqrt(0.5)
CUBE = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
ROOM = ((-1.5, -2.0, -0.6), (1.5, 2.0, 2.0))


def test_a_quarter_turn_about_z() -> None:
    columns = rotation_columns((0.0, 0.0, HALF, HALF))
    expected = ((0, 1, 0), (-1, 0, 0), (0, 0, 1))
    for column, wanted in zip(columns, expected, strict=True):
        assert column == pytest.approx(wanted)


def test_every_multiple_of_a_quaternion_is_one() -> None:
    q = (0.1, -0.2, 0.3, 0.5)
    for factor in (1.0, -1.0, 7.5, -1e-3):
        assert normal_quaternion([factor * value for value in q]) == normal_quaternion(q)
    assert normal_quaternion((0, 0, -1, 0)) == normal_quaternion((0, 0, 1, 0)) == (0.0, 0.0, 1.0, 0.0)
    assert normal_quaternion((-1, 0, 0, 0)) == (1.0, 0.0, 0.0, 0.0)
    assert str(normal_quaternion((-0.0, 0.0, -0.0, 2.0))) == "(0.0, 0.0, 0.0, 1.0)", "no negative zero"


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
    center: Vector, size: Vector, xyzw: tuple[float, float, float, float], overlap: bool
) -> None:
    assert (distance(Detection(center, size, xyzw), CUBE) == 0) is overlap


def test_no_box_with_a_point_inside_is_called_outside() -> None:
    """The slow way: a grid of points in the box; any of them in the bounds proves an overlap."""
    rng = random.Random(0)
    proved = 0
    for _ in range(300):
        center = (rng.uniform(-2.5, 2.5), rng.uniform(-2.5, 2.5), rng.uniform(-2.5, 2.5))
        size = (rng.uniform(0.1, 3), rng.uniform(0.1, 3), rng.uniform(0.1, 3))
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
            assert distance(Detection(center, size, xyzw), CUBE) == 0
    assert 50 < proved < 290


@pytest.mark.parametrize(
    ("center", "apart"),
    [
        ((3, 0, 0), 1.5),
        ((-3, 0, 0), 1.5),
        ((3, 3, 0), math.hypot(1.5, 1.5)),
        ((3, 3, 3), 1.5 * math.sqrt(3)),
        ((0, 0, 0), 0),
    ],
)
def test_the_distance_of_upright_boxes_is_exact(center: Vector, apart: float) -> None:
    assert distance(Detection(center, (1, 1, 1)), CUBE) == pytest.approx(apart)


@pytest.mark.parametrize(
    ("box", "said", "hint"),
    [
        (
            Detection((-562, -283, 200), (546, 598, 511)),
            "units from the scene's bounds",
            "in millimeters? Divided by 1000",
        ),
        (Detection((-56.2, -28.3, 20.0), (54.6, 59.8, 51.1)), "units from", "centimeters or inches? Divided by 100 or"),
        (Detection((39.37, 39.37, 39.37), (20, 20, 20)), "units from", "or inches?"),
        (
            Detection((20, 20, 20), (1, 1, 1)),
            "the size [1, 1, 1], the scene reaches from [-1.5, -2, -0.6]",
            "own frame",
        ),
    ],
)
def test_a_box_outside_tells_how_far_and_what_may_be_wrong(box: Detection, said: str, hint: str) -> None:
    with pytest.raises(InvalidDetectionError) as caught:
        require_in_scene(box, ROOM)
    assert caught.value.reason == "DETECTION_OUTSIDE_SCENE"
    assert said in str(caught.value)
    assert hint in (caught.value.hint or "")


def test_a_scene_of_another_unit_is_named_too() -> None:
    room = tuple(tuple(1000 * value + 5000 for value in corner) for corner in ROOM)
    with pytest.raises(InvalidDetectionError) as caught:
        require_in_scene(Detection((5.2, 5.1, 5.3), (0.5, 0.5, 0.5)), (room[0], room[1]))
    assert "Is the scene in millimeters?" in (caught.value.hint or "")


def test_a_box_many_times_the_scene_is_refused_too() -> None:
    with pytest.raises(InvalidDetectionError, match="many times larger") as caught:
        require_in_scene(Detection((100, 80, 120), (550, 600, 520)), ROOM)
    assert caught.value.reason == "INVALID_DETECTION"
    assert "millimeters" in (caught.value.hint or "")
    require_in_scene(Detection((0, 0, 0), (30, 30, 30)), ROOM)


def test_swapped_scene_and_object_are_noticed() -> None:
    box = Detection((1.0, 1.5, 1.0), (0.5, 0.5, 0.5))
    with pytest.raises(InvalidDetectionError) as caught:
        require_in_scene(box, ((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)), ROOM)
    assert "swapped" in (caught.value.hint or "")


def test_a_scene_without_bounds_refuses_nothing() -> None:
    far = Detection((9, 9, 9), (1, 1, 1))
    require_in_scene(far, ([-math.inf] * 3, [math.inf] * 3))
    with pytest.raises(InvalidDetectionError):
        require_in_scene(far, ROOM)

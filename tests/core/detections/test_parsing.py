"""The detection parser: every form gives the box it means, and what is unclear is refused with what to write."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core import OrientedBox
from regnf_core.detections import Detection, parse_detection, require_in_scene
from regnf_core.detections.bounds import distance
from regnf_core.errors import InvalidDetectionError
from regnf_core.rotations import Vector, normal_quaternion, rotation_columns

HALF = math.sqrt(0.5)
QUARTER = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
"""A quarter turn about z."""
UNIT = {"center": [0, 0, 0], "size": [1, 1, 1]}
AXIS_ALIGNED = parse_detection({"center": [0.5, 1.0, 1.5], "size": [1, 2, 3]})
TURNED = OrientedBox(torch.tensor([1.0, 2, 3]), torch.tensor([4.0, 5, 6]), torch.tensor(QUARTER))


@pytest.mark.parametrize(
    "values",
    [
        {"min": [0, 0, 0], "max": [1, 2, 3]},
        {"min_bound": [0, 0, 0], "max_bound": [1, 2, 3], "class_name": "AxisAlignedBoundingBox"},
        {"min": {"x": 0, "y": 0, "z": 0}, "max": {"x": 1, "y": 2, "z": 3}},
        {"center": np.array([0.5, 1.0, 1.5]), "extent": torch.tensor([1, 2, 3]), "R": np.eye(3)},
        {"center": {"x": 0.5, "y": 1, "z": 1.5}, "size": {"x": 1, "y": 2, "z": 3}},
        {"center": [0.5, 1.0, 1.5], "size": [1, 2, 3], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"center": [0.5, 1.0, 1.5], "size": [1, 2, 3], "label": None, "score": None},
    ],
)
def test_forms_of_an_axis_aligned_box(values: Any) -> None:
    assert parse_detection(values) == AXIS_ALIGNED


@pytest.mark.parametrize(
    "rotation",
    [
        {"rotation": QUARTER},
        {"R": QUARTER},
        {"R": np.array(QUARTER)},
        {"rotation_quaternion_xyzw": [0, 0, HALF, HALF]},
        {"rotation_quaternion_xyzw": [0, 0, -7, -7]},
        {"rotation_quaternion_wxyz": [HALF, 0, 0, HALF]},
        {"rotation": {"x": 0, "y": 0, "z": HALF, "w": HALF}},
        {"rotation": [[0.0002, -1, 0], [1, 0.0002, 0], [0, 0, 1]]},
    ],
)
def test_forms_of_a_rotation(rotation: dict[str, Any]) -> None:
    box = OrientedBox.from_dict({"center": [1, 2, 3], "size": [4, 5, 6]} | rotation)
    torch.testing.assert_close(box.corners(), TURNED.corners(), atol=2e-3, rtol=0)


@pytest.mark.parametrize("seed", range(8))
def test_every_rotation_matrix_is_read_as_it_is(seed: int) -> None:
    q = np.random.default_rng(seed).normal(size=4)
    box = OrientedBox.from_quaternion([0, 0, 0], [1, 2, 3], q.tolist())
    again = OrientedBox.from_dict({"center": [0, 0, 0], "size": [1, 2, 3], "R": box.rotation})
    torch.testing.assert_close(again.rotation, box.rotation)
    turn = box.to_detection().canonical()["rotation_quaternion_xyzw"]
    assert turn == pytest.approx(normal_quaternion(q.tolist()), abs=1e-11)


@pytest.mark.parametrize(
    ("values", "place", "said", "hint"),
    [
        ({}, ("center",), "detection.center is missing", '{"min": [x, y, z]'),
        ({"center": [0, 0, 0]}, ("size",), "detection.size is missing: `center` is there", "min"),
        ({"extent": [1, 1, 1]}, ("center",), "`extent` is there", "min"),
        ({"min": [0, 0, 0]}, ("max",), "detection.max is missing", "max"),
        ("box.json", (), 'is the text "box.json"', "min"),
        (None, (), "is null", "min"),
        (7, (), "is 7", "min"),
        ([0, 0, 0, 1, 1, 1], (), "is a list of 6", "min"),
        ([], (), "an empty list", "min"),
        ([[0, 0], [1, 1]], (0,), "detection[0] has 2 entries, expected 3", "[x, y, z]"),
        ([UNIT], (), "a list of 1 detection", "--detection-index"),
        ({"detections": [UNIT, UNIT]}, ("detections",), "a list of 2 detections", "0: a box, 1: a box"),
        ([UNIT | {"label": "chair", "score": 0.5}], (), "1 detection", '0: the text "chair" 0.5'),
        ({"centr": [0, 0, 0], "size": [1, 1, 1]}, ("centr",), "detection.centr", "Did you mean `center`?"),
        ({"Center": [0, 0, 0], "size": [1, 1, 1]}, ("Center",), "detection.Center", "Did you mean `center`?"),
        ({"position": [0, 0, 0], "size": [1, 1, 1]}, ("position",), "", "Did you mean `center`?"),
        (UNIT | {"quaternion": [0, 0, 0, 1]}, ("quaternion",), "", "`rotation_quaternion_wxyz`"),
        (UNIT | {"yaw": 0.3}, ("yaw",), "detection.yaw", "sin(a/2)"),
        ({"center": [0, 0, 0], "half_extents": [1, 1, 1]}, ("half_extents",), "", "twice"),
        ({"center": [0, 0, 0], "dimensions": [1, 1, 1]}, ("dimensions",), "", "`size`"),
        ({"token": "a", "translation": [0, 0, 0], "size": [1, 1, 1]}, ("translation",), "", "[length, width, height]"),
        (UNIT | {"zzzz": 1}, ("zzzz",), "detection.zzzz", "docs/api.md"),
        (UNIT | {"color": 1}, ("color",), "detection.color", ""),
        (UNIT | {"extent": [0, 0, 0]}, ("extent",), "is given twice, also as `size`", "Leave one"),
        ({"centre": [0, 0, 0], "size": [1, 1, 1]}, ("centre",), "", "Did you mean `center`?"),
        ({"center": [0, 0, 0], "extents": [1, 1, 1]}, ("extents",), "", "twice Unity's"),
        ({"center": [0, 0, 0], "extent": [1, 1, 1]}, ("extent",), "half of them", "full edge lengths"),
        (UNIT | {"rotation_matrix": QUARTER}, ("rotation_matrix",), "", "Did you mean `rotation`?"),
        (UNIT | {"min": [0, 0, 0], "max": [1, 1, 1]}, ("center",), "corners too", "Leave one"),
        (UNIT | {"R": QUARTER, "rotation_quaternion_xyzw": [0, 0, 0, 1]}, ("rotation_quaternion_xyzw",), "`R`", ""),
        (UNIT | {"rotation": [0, 0, 0, 1]}, ("rotation",), "[0, 0, 0, 1]", "`rotation_quaternion_xyzw`: [0, 0, 0, 1]"),
        (UNIT | {"rotation": [1, 0, 0, 0]}, ("rotation",), "unknown order", "`rotation_quaternion_wxyz`: [1, 0, 0, 0]"),
        (UNIT | {"R": np.eye(4)}, ("R",), "a list of 4", "three rows"),
        (UNIT | {"R": np.eye(3).ravel()}, ("R",), "a list of 9", "three rows"),
        (UNIT | {"rotation": 0.5}, ("rotation",), "is 0.5", "three rows"),
        (UNIT | {"rotation": None}, ("rotation",), "is null", "three rows"),
        (UNIT | {"rotation": 2 * np.eye(3)}, ("rotation",), "by 3", "perpendicular"),
        (UNIT | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, ("rotation",), "reflection", "Negate"),
        (UNIT | {"rotation": [[1, 0, 0], [0, "1", 0], [0, 0, 1]]}, ("rotation", 1, 1), '"1"', "quotation"),
        (UNIT | {"rotation_quaternion_xyzw": [0, 0, 0, 0]}, ("rotation_quaternion_xyzw",), "is zero", ""),
        (UNIT | {"rotation_quaternion_xyzw": [0, 0, 1]}, ("rotation_quaternion_xyzw",), "3 entries, expected 4", ""),
        (UNIT | {"center": [math.nan, 0, 0]}, ("center", 0), "detection.center[0] is NaN", ""),
        (UNIT | {"center": [0, math.inf, 0]}, ("center", 1), "is inf", ""),
        (UNIT | {"center": [0, 0, 10**400]}, ("center", 2), "is a huge number", ""),
        (UNIT | {"center": [2e9, 0, 0]}, ("center", 0), "is 2e+09, expected an absolute value of at most 1e+09", ""),
        (UNIT | {"center": ["0", 0, 0]}, ("center", 0), 'is the text "0"', "quotation marks"),
        (UNIT | {"center": [True, 0, 0]}, ("center", 0), "is true", ""),
        (UNIT | {"center": "0 0 0"}, ("center",), "is a text", "[x, y, z]"),
        (UNIT | {"center": {"x": 0}}, ("center",), "other members than x, y, z", "[x, y, z]"),
        (UNIT | {"size": [1, 0, 1]}, ("size", 1), "detection.size[1] is 0", "flat"),
        (UNIT | {"size": [1, -2, 1]}, ("size", 1), "detection.size[1] is -2", "`min` and `max`"),
        ({"min": [1, 1, 1], "max": [0, 0, 0]}, ("max", 0), "is 0, expected more than min[0], which is 1", "swapped"),
        ({"min": [0, 0, 0], "max": [1, -1, 1]}, ("max", 1), "is -1", "lowest corner"),
        (UNIT | {"score": 91}, ("score",), "is 91", "percentage"),
        (UNIT | {"score": "high"}, ("score",), 'the text "high"', ""),
        (UNIT | {"label": "a\r\nb"}, ("label",), "printable", ""),
        (UNIT | {"label": ""}, ("label",), "printable", ""),
    ],
)
def test_what_is_refused(values: Any, place: tuple[str | int, ...], said: str, hint: str) -> None:
    with pytest.raises(InvalidDetectionError) as caught:
        parse_detection(values)
    assert caught.value.reason == "INVALID_DETECTION"
    assert caught.value.place == place
    assert said in str(caught.value)
    assert hint in (caught.value.hint or "")


def test_one_of_several_is_chosen_by_its_index() -> None:
    several = {"detections": [UNIT, UNIT | {"size": [2, 2, 2]}]}
    assert parse_detection(several, 1).size == (2, 2, 2)
    assert parse_detection(several["detections"], 0).size == (1, 1, 1)
    for index in (2, -1):
        with pytest.raises(InvalidDetectionError, match=f"has no entry {index}"):
            parse_detection(several, index)
    with pytest.raises(InvalidDetectionError, match="a single box"):
        parse_detection(UNIT, 0)


@pytest.mark.parametrize("form", [list, tuple, np.array, torch.tensor])
def test_two_lists_are_corners_only_where_they_can_be_nothing_else(form: Any) -> None:
    assert parse_detection(form([[-1.0, -2, -3], [0, 0, 0]])) == replace(AXIS_ALIGNED, center=(-0.5, -1.0, -1.5))
    with pytest.raises(InvalidDetectionError, match="corners, or a center and a size") as caught:
        parse_detection(form([[0.0, 0, 0], [1, 2, 3]]))
    assert all(name in str(caught.value.hint) for name in ('"min"', '"max"', '"center"', '"size"'))


# Boxes as plain numbers, by hand-computed cases and a slow reference.


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


FAR_ROOM = ((3500.0, 3000.0, 4400.0), (6500.0, 7000.0, 7000.0))
OUTSIDE = "DETECTION_OUTSIDE_SCENE"


@pytest.mark.parametrize(
    ("box", "scenes", "reason", "said", "hint"),
    [
        (
            Detection((-562, -283, 200), (546, 598, 511)),
            [ROOM],
            OUTSIDE,
            "units from the scene's bounds",
            "in millimeters? Divided by 1000",
        ),
        (
            Detection((-56.2, -28.3, 20.0), (54.6, 59.8, 51.1)),
            [ROOM],
            OUTSIDE,
            "",
            "centimeters or inches? Divided by 100",
        ),
        (Detection((39.37, 39.37, 39.37), (20, 20, 20)), [ROOM], OUTSIDE, "units from", "or inches?"),
        (
            Detection((20, 20, 20), (1, 1, 1)),
            [ROOM],
            OUTSIDE,
            "the size [1, 1, 1], the scene reaches from [-1.5, -2, -0.6]",
            "own frame",
        ),
        (Detection((5.2, 5.1, 5.3), (0.5, 0.5, 0.5)), [FAR_ROOM], OUTSIDE, "", "Is the scene in millimeters?"),
        (Detection((1.0, 1.5, 1.0), (0.5, 0.5, 0.5)), [((-0.3,) * 3, (0.3,) * 3), ROOM], OUTSIDE, "", "swapped"),
        (
            Detection((100, 80, 120), (550, 600, 520)),
            [ROOM],
            "INVALID_DETECTION",
            "many times larger",
            "millimeters",
        ),
    ],
)
def test_a_box_outside_tells_how_far_and_what_may_be_wrong(
    box: Detection, scenes: Any, reason: str, said: str, hint: str
) -> None:
    with pytest.raises(InvalidDetectionError) as caught:
        require_in_scene(box, *scenes)
    assert caught.value.reason == reason
    assert said in str(caught.value)
    assert hint in (caught.value.hint or "")


def test_a_scene_without_bounds_refuses_nothing() -> None:
    far = Detection((9, 9, 9), (1, 1, 1))
    with pytest.raises(InvalidDetectionError):
        require_in_scene(far, ROOM)
    assert require_in_scene(far, ([-math.inf] * 3, [math.inf] * 3)) is None  # type: ignore[func-returns-value]
    around = Detection((0, 0, 0), (30, 30, 30))
    assert require_in_scene(around, ROOM) is None  # type: ignore[func-returns-value]

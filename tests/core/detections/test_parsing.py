"""The detection parser: every form gives the box it means, and what is unclear is refused with what to write."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from regnf_core import OrientedBox
from regnf_core.detections import parse_detection
from regnf_core.errors import InvalidDetectionError
from regnf_core.rotations import normal_quaternion

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
        [[0, 0, 0], [1, 2, 3]],
        ((0, 0, 0), (1, 2, 3)),
        np.array([[0, 0, 0], [1, 2, 3]]),
        {"min_bound": [0, 0, 0], "max_bound": [1, 2, 3], "class_name": "AxisAlignedBoundingBox"},
        {"min": {"x": 0, "y": 0, "z": 0}, "max": {"x": 1, "y": 2, "z": 3}},
        {"center": np.array([0.5, 1.0, 1.5]), "extent": torch.tensor([1, 2, 3])},
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
        (UNIT | {"extent": [0, 0, 0]}, ("extent",), "says the same as `size`", "Leave one"),
        ({"centre": [0, 0, 0], "size": [1, 1, 1]}, ("centre",), "", "Did you mean `center`?"),
        ({"center": [0, 0, 0], "extents": [1, 1, 1]}, ("extents",), "", "Did you mean `size`?"),
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
        (UNIT | {"center": [2e9, 0, 0]}, ("center", 0), "is 2e+09, expected at most 1e+09", ""),
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


def test_an_array_is_no_list_of_detections() -> None:
    assert parse_detection(torch.tensor([[0.0, 0, 0], [1, 2, 3]])) == AXIS_ALIGNED

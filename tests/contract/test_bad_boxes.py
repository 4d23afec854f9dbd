"""Detections that are refused: the reason, the pointer, nothing left behind, and the next one works."""

from __future__ import annotations

from typing import Any

import pytest

from tests.contract.bad_input import post
from tests.contract.world import BOX, World, assert_refused

pytestmark = pytest.mark.usefixtures("nothing_of_a_request_stays")
UNIT = {"center": [0, 0, 0], "size": [1, 1, 1]}


@pytest.mark.parametrize(
    ("box", "pointer"),
    [
        pytest.param(None, "/detection", id="none"),
        pytest.param([], "/detection", id="an empty list"),
        pytest.param([BOX, BOX], "/detection", id="too many"),
        pytest.param([BOX], "/detection", id="a list of one"),
        pytest.param(UNIT | {"rotation": [0, 0, 0, 1]}, "/detection/rotation", id="a quaternion of unknown order"),
        pytest.param(UNIT | {"yaw": 1}, "/detection/yaw", id="a yaw"),
        pytest.param({}, "/detection/center", id="empty"),
        pytest.param("the chair", "/detection", id="a word"),
        pytest.param(UNIT | {"center": [float("nan"), 0, 0]}, "/detection/center/0", id="NaN"),
        pytest.param(UNIT | {"center": [0, float("inf"), 0]}, "/detection/center/1", id="Inf"),
        pytest.param(UNIT | {"center": [0, 0, float("-inf")]}, "/detection/center/2", id="-Inf"),
        pytest.param(UNIT | {"center": [1e308, 0, 0]}, "/detection/center/0", id="1e308"),
        pytest.param(UNIT | {"center": [10**400, 0, 0]}, "/detection/center/0", id="10^400"),
        pytest.param(UNIT | {"center": ["0", 0, 0]}, "/detection/center/0", id="a string for a number"),
        pytest.param(UNIT | {"center": [True, 0, 0]}, "/detection/center/0", id="a boolean for a number"),
        pytest.param(UNIT | {"center": [None, 0, 0]}, "/detection/center/0", id="null for a number"),
        pytest.param(UNIT | {"center": [0, 0]}, "/detection/center", id="two coordinates"),
        pytest.param(UNIT | {"center": [0, 0, 0, 0]}, "/detection/center", id="four coordinates"),
        pytest.param(UNIT | {"size": [1, 0, 1]}, "/detection/size/1", id="zero extent"),
        pytest.param(UNIT | {"size": [1, -1, 1]}, "/detection/size/1", id="negative extent"),
        pytest.param(UNIT | {"size": [1, 1, float("nan")]}, "/detection/size/2", id="NaN extent"),
        pytest.param(
            UNIT | {"rotation_quaternion_xyzw": [0, 0, 0, 0]},
            "/detection/rotation_quaternion_xyzw",
            id="zero quaternion",
        ),
        pytest.param(
            UNIT | {"rotation_quaternion_xyzw": [0, 0, 1]},
            "/detection/rotation_quaternion_xyzw",
            id="three parts of a quaternion",
        ),
        pytest.param(
            UNIT | {"rotation_quaternion_xyzw": [0, 0, 0, 1e308]},
            "/detection/rotation_quaternion_xyzw/3",
            id="a quaternion of 1e308",
        ),
        pytest.param(
            UNIT | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]},
            "/detection/rotation",
            id="a matrix of determinant -1",
        ),
        pytest.param(UNIT | {"score": 1.5}, "/detection/score", id="score above 1"),
        pytest.param(UNIT | {"score": -0.1}, "/detection/score", id="score below 0"),
        pytest.param(UNIT | {"score": True}, "/detection/score", id="score a boolean"),
        pytest.param(UNIT | {"score": float("nan")}, "/detection/score", id="score NaN"),
        pytest.param(UNIT | {"label": ""}, "/detection/label", id="empty label"),
        pytest.param(UNIT | {"label": "a" * 201}, "/detection/label", id="label of 201"),
        pytest.param(UNIT | {"label": "a\r\nX-Bad: 1"}, "/detection/label", id="label with CR/LF"),
        pytest.param(UNIT | {"label": "a\u202eb"}, "/detection/label", id="label with RTL"),
        pytest.param(UNIT | {"label": "a\0b"}, "/detection/label", id="label with NUL"),
        pytest.param(UNIT | {"id": 1}, "/detection/id", id="an id"),
        pytest.param({"min": [0, 0, 0], "max": [1, -1, 1]}, "/detection/max/1", id="min above max"),
        pytest.param({"min": [0, 0, 0], "max": [1, 0, 1]}, "/detection/max/1", id="min equal to max"),
        pytest.param({"min": [0, 0, 0]}, "/detection/max", id="min alone"),
        pytest.param(UNIT | {"min": [0, 0, 0], "max": [1, 1, 1]}, "/detection/center", id="both spellings"),
    ],
)
def test_boxes(world: World, box: Any, pointer: str) -> None:
    problem = assert_refused(post(world, world.valid_request() | {"detection": box}), 422, "INVALID_DETECTION")
    assert pointer in [entry["pointer"] for entry in problem["errors"]]
    assert problem["detail"].startswith("detection")
    assert problem["detail"] == problem["errors"][0]["detail"]


def test_the_hint_says_what_was_meant(world: World) -> None:
    box = {"centr": [0, 0, 0], "size": [1, 1, 1]}
    problem = assert_refused(post(world, world.valid_request() | {"detection": box}), 422, "INVALID_DETECTION")
    assert problem["hint"] == "Did you mean `center`?"


CENTER, SIZE = [-0.125, -0.0625, 0.25], [0.5, 0.25, 0.125]
LOW, HIGH = [-0.375, -0.1875, 0.1875], [0.125, 0.0625, 0.3125]
"""The same box, without rounding."""


@pytest.mark.parametrize(
    "box",
    [
        {"center": CENTER, "extent": SIZE, "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"min_bound": LOW, "max_bound": HIGH},
        [LOW, HIGH],
        {"center": dict(zip("xyz", CENTER, strict=True)), "size": dict(zip("xyz", SIZE, strict=True))},
        {"center": CENTER, "size": SIZE, "rotation_quaternion_wxyz": [-2, 0, 0, 0]},
    ],
)
def test_every_form_of_a_box_is_one_job(world: World, box: Any) -> None:
    answers = [
        world.client.post("/register?dry_run=true", json=world.valid_request() | {"detection": form})
        for form in ({"center": CENTER, "size": SIZE}, box)
    ]
    assert [answer.status_code for answer in answers] == [200, 200], answers[1].text
    assert answers[0].json() == answers[1].json()


@pytest.mark.parametrize(
    "box",
    [
        {"min": [1.1, 0, 0], "max": [1.2, 1, 1]},
        {"center": [150.0, 50.0, 200.0], "size": [500.0, 20.0, 40.0]} | {"center": [-1500.0, 50.0, 200.0]},
        # its corner points at the scene's corner, but stays short of it: only a slanted axis tells
        {"center": [1.8, 1.8, 0], "size": [1, 1, 1], "rotation_quaternion_xyzw": [0, 0, 0.38268343, 0.92387953]},
    ],
)
def test_a_box_wholly_outside_the_scene(world: World, box: dict[str, Any]) -> None:
    problem = assert_refused(post(world, world.valid_request() | {"detection": box}), 422, "DETECTION_OUTSIDE_SCENE")
    assert "units from the scene's bounds" in problem["detail"]


def test_a_box_in_millimeters_is_told_so(world: World) -> None:
    box = {"center": [-562.0, -283.0, -243.0], "size": [546.0, 598.0, 511.0]}
    problem = assert_refused(post(world, world.valid_request() | {"detection": box}), 422, "DETECTION_OUTSIDE_SCENE")
    assert problem["detail"].startswith(
        "the box is 288 units from the scene's bounds: the center is [-562, -283, -243]"
    )
    assert "millimeters" in problem["hint"]


def test_a_label_that_nobody_knows_is_a_note(world: World) -> None:
    """It is kept, and asks for nothing: there is no list of labels."""
    box = BOX | {"label": "a thing that no detector names"}
    answer = world.client.post("/register?dry_run=true", json=world.valid_request() | {"detection": box})
    assert answer.status_code == 200

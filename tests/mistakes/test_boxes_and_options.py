"""Detections and options that a new user writes by mistake, at the command line."""

# ruff: noqa: E501 -- a mistake is one line of a table
from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.conftest import Run
from tests.mistakes.case import Case, parametrized

FORMS = '"min"|`min`'
MADE_FOR_MM = '{"center": [-560, -280, -240], "size": [550, 600, 510]}'
BOXES = [
    Case("trailing comma", "MALFORMED_JSON", 2, "b.json.*line 1, column", "not JSON", "Remove the comma", '{"center": [0, 0, 0],}'),
    Case("single quotes", "MALFORMED_JSON", 2, "b.json.*line 1, column 2", "not JSON", "double quotes", "{'center': [0, 0, 0]}"),
    Case("Python's None", "MALFORMED_JSON", 2, "b.json", "not JSON", "Write null", '{"label": None}'),
    Case("quotes of a program for letters", "MALFORMED_JSON", 2, "b.json", "not JSON", "straight quotes", '{\u201ccenter\u201d: [0, 0, 0]}'),
    Case("comment", "MALFORMED_JSON", 2, "b.json", "not JSON", "no comments", '// box\n{"center": [0, 0, 0]}'),
    Case("YAML", "MALFORMED_JSON", 2, "b.json", "not JSON", "Write it as JSON", "center: [0, 0, 0]"),
    Case("empty detection", "MALFORMED_JSON", 2, "b.json", "value is expected", "It is empty", ""),
    Case("cut off", "MALFORMED_JSON", 2, "b.json", "not JSON", "ends too early", '{"center": [0, 0, 0]'),
    Case("NaN", "INVALID_DETECTION", 2, r"b.json: detection.center\[0\] is NaN", "expected a finite", "Leave such boxes out", '{"center": [NaN, 0, 0], "size": [1, 1, 1]}'),
    Case("numbers as texts", "INVALID_DETECTION", 2, r'center\[0\] is the text "0"', "expected a number", "quotation", '{"center": ["0", 0, 0], "size": [1, 1, 1]}'),
    Case("no size", "INVALID_DETECTION", 2, "detection.size", "is missing", FORMS, '{"center": [0, 0, 0]}'),
    Case("misspelled member", "INVALID_DETECTION", 2, "detection.cnter", "not a member", "Did you mean `center`", '{"cnter": [0, 0, 0], "size": [1, 1, 1]}'),
    Case("position", "INVALID_DETECTION", 2, "detection.position", "not a member", "Did you mean `center`", '{"position": [0, 0, 0], "size": [1, 1, 1]}'),
    Case("yaw", "INVALID_DETECTION", 2, "detection.yaw", "not a member", "rotation_quaternion_xyzw", '{"center": [0, 0, 0], "size": [1, 1, 1], "yaw": 90}'),
    Case("half extents", "INVALID_DETECTION", 2, "half_extents", "not a member", "full edge lengths", '{"center": [0, 0, 0], "half_extents": [1, 1, 1]}'),
    Case("order of the quaternion", "INVALID_DETECTION", 2, r"detection.rotation is a quaternion of unknown order, \[1, 0, 0, 0\]", "unknown order", "xyzw.*wxyz", '{"center": [0, 0, 0], "size": [1, 1, 1], "rotation": [1, 0, 0, 0]}'),
    Case("scaled matrix", "INVALID_DETECTION", 2, "detection.R", "not a rotation: R R", "Put the scale into `size`", '{"center": [0, 0, 0], "size": [1, 1, 1], "R": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}'),
    Case("reflection", "INVALID_DETECTION", 2, "detection.R", "expected a rotation", "Negate", '{"center": [0, 0, 0], "size": [1, 1, 1], "R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}'),
    Case("swapped corners", "INVALID_DETECTION", 2, r"max\[0\] is -0.8", "expected more than min", "are swapped", '{"min": [0.1, 0.2, 0.3], "max": [-0.8, -0.5, -0.4]}'),
    Case("negative size", "INVALID_DETECTION", 2, r"size\[2\] is -0.5", "above 0", "full edge lengths", '{"center": [0, 0, 0], "size": [1, 1, -0.5]}'),
    Case("brackets without an end", "MALFORMED_JSON", 2, "b.json", "nested|deep", "", "[" * 100_000),
    Case("flat box", "INVALID_DETECTION", 2, r"size\[2\] is 0", "above 0", "thick", '{"center": [0, 0, 0], "size": [1, 1, 0]}'),
    Case("list of detections", "INVALID_DETECTION", 2, "b.json: detection is a list of 1", "expected one box", "--detection-index", '[{"center": [0, 0, 0], "size": [1, 1, 1]}]'),
    Case("document of detections", "INVALID_DETECTION", 2, "detection.detections is a list of 2", "expected one box", "--detection-index", '{"detections": [{"label": "chair"}, {"label": "table"}]}'),
    Case("six numbers", "INVALID_DETECTION", 2, "a list of 6", "expected an object", FORMS, "[0, 0, 0, 1, 1, 1]"),
    Case("score in percent", "INVALID_DETECTION", 2, "score is 91", "from 0 to 1", "Divide", '{"center": [0, 0, 0], "size": [1, 1, 1], "score": 91}'),
    Case("millimeters", "DETECTION_OUTSIDE_SCENE", 2, "room.safetensors: the box is .* units", "the scene reaches from", "millimeters", MADE_FOR_MM),
    Case("a box beside the scene", "DETECTION_OUTSIDE_SCENE", 2, r"the center is \[0, 9, 0\]", "the scene reaches from", "regnf inspect", '{"center": [0, 9, 0], "size": [1, 1, 1]}'),
    Case("a box of another unit around the scene", "INVALID_DETECTION", 2, r"size \[550, 600, 510\]", "larger than the scene", "millimeters", '{"center": [100, 80, 90], "size": [550, 600, 510]}'),
]  # fmt: skip
OPTIONS = [
    Case("spelling of earlier versions", "INVALID_OPTIONS", 2, "o.json: options.initialisation", "no such option", "did you mean `initialization`", '{"initialisation": {}}'),
    Case("limit of a share", "INVALID_OPTIONS", 2, "o.json: options.robust.min_inlier_share", "no such option", "see `robust.acceptance`", '{"robust": {"min_inlier_share": 0.5}}'),
    Case("misspelled option", "INVALID_OPTIONS", 2, "o.json: options.robust.rotation", "no such option", "did you mean `robust.rotations`", '{"robust": {"rotation": 5}}'),
    Case("option of another type", "INVALID_OPTIONS", 2, "o.json: options.robust.rotations", "valid integer", "regnf manual api", '{"robust": {"rotations": "many"}}'),
    Case("option out of range", "INVALID_OPTIONS", 2, "o.json: options.robust.rotations", "less than or equal to 20000", "regnf manual api", '{"robust": {"rotations": 1000000}}'),
    Case("misspelled preset", "INVALID_OPTIONS", 2, "o.json: options.preset", "'paper' or 'robust'", "regnf manual api", '{"preset": "papr"}'),
    Case("options as a list", "MALFORMED_JSON", 2, "o.json", "expected a JSON object", "Write a JSON object", "[]"),
]  # fmt: skip


@parametrized(BOXES)
def test_a_wrong_box(case: Case, run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before any field is opened: there is nothing left that could open one."""
    monkeypatch.delattr("regnf_core.loading.load_field")
    (folder / "b.json").write_text(case.how)
    outcome = run("register", "room.safetensors", "chair.safetensors", "--detection", "b.json", code=case.code)
    assert outcome.stderr.startswith(case.reason)
    assert outcome.stdout == ""
    case.check(outcome.stderr)


@parametrized(OPTIONS)
def test_wrong_options(case: Case, run: Run, folder: Path) -> None:
    (folder / "o.json").write_text(case.how)
    outcome = run(
        "register",
        "room.safetensors",
        "chair.safetensors",
        "--detection",
        "box.json",
        "--options",
        "o.json",
        code=case.code,
    )
    assert outcome.stderr.startswith(case.reason)
    assert outcome.stderr.count("\n") == 2  # the message and the hint, however narrow the terminal
    case.check(outcome.stderr)


def test_swapped_scene_and_object(run: Run, folder: Path) -> None:
    (folder / "far.json").write_text(json.dumps({"center": [1.1, 1.1, 0.0], "size": [0.3, 0.3, 0.3]}))
    outcome = run("register", "chair.safetensors", "room.safetensors", "--detection", "far.json", code=2)
    assert outcome.stderr.startswith("DETECTION_OUTSIDE_SCENE chair.safetensors: the box is")
    assert "whether scene and object are swapped." in outcome.stderr


def test_the_same_file_twice(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_cli.registration.register_here", lambda *_: {"verdict": "rejected"})
    monkeypatch.setattr("regnf_cli.report.show_result", lambda _: None)
    outcome = run("register", "room.safetensors", "room.safetensors", "--detection", "box.json", code=1)
    assert "warning: scene and object are the same file, room.safetensors" in outcome.stderr


def test_one_detection_of_several(run: Run, folder: Path) -> None:
    boxes = {"detections": [{"center": [0, 0, 0], "size": [1, 1, 0]}, {"center": [0, 9, 0], "size": [1, 1, 1]}]}
    (folder / "b.json").write_text(json.dumps(boxes))
    command = ["register", "room.safetensors", "chair.safetensors", "--detection", "b.json", "--detection-index"]
    assert run(*command, "0").stderr.startswith("INVALID_DETECTION b.json: detection.size[2] is 0")
    assert run(*command, "1").stderr.startswith("DETECTION_OUTSIDE_SCENE ")
    outcome = run(*command, "2")
    assert "has no entry 2" in outcome.stderr
    assert "Choose one of 0 to 1" in outcome.stderr

# ruff: noqa: E501 -- a mistake is one line of a table
"""What a new user gets wrong with ``import regnf``: every message names, expects, and says what to do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import regnf
from tests.core.analytic import chair, chair_pose, room
from tests.mistakes.case import Case, parametrized

BOX = {"center": [-0.56, -0.28, -0.24], "size": [0.55, 0.6, 0.51]}
ROOM, CHAIR = "room.safetensors", "chair.safetensors"
wrong: Any = regnf
"""The same functions, for calls that a type checker would refuse."""


def registered(scene: Any = ROOM, obj: Any = CHAIR, detection: Any = BOX, **more: Any) -> Any:
    return lambda: wrong.register(scene, obj, detection, **more)


def batch(detections: Any, **more: Any) -> Any:
    return lambda: wrong.register_batch(ROOM, detections, [CHAIR], **more)


CASES = [
    Case("scene misspelled", "FILE_NOT_FOUND", 0, "rom.safetensors", "no such file", "Did you mean room.safetensors", registered("rom.safetensors")),
    Case("object misspelled", "FILE_NOT_FOUND", 0, "chiar.safetensors", "no such file", "Did you mean chair.safetensors", registered(obj="chiar.safetensors")),
    Case("folder of no run", "RUN_WITHOUT_CHECKPOINT", 0, "nothing", "checkpoint", "Give the folder of one training run", lambda: wrong.open_field(Path("nothing"))),
    Case("no scene", "NO_FIELD", 0, "the scene is of the type NoneType", "expected a field or its path", "open_field", registered(None)),
    Case("array for an object", "NO_FIELD", 0, "the object is of the type numpy ndarray", "expected a field or its path", "open_field", registered(obj=np.zeros((3, 3)))),
    Case("settings for a field", "FORMAT_NOT_RECOGNIZED", 0, "config.yml", "expected a field", "step-000030000.ckpt", registered("run/config.yml")),
    Case("text for options", "INVALID_OPTIONS", 0, "options is a str", "expected a dictionary", "up_axis", registered(options="robust")),
    Case("option misspelled", "INVALID_OPTIONS", 0, "options.upaxis", "no such option", "did you mean `up_axis`", registered(options={"upaxis": "z"})),
    Case("option in the wrong group", "INVALID_OPTIONS", 0, "options.rotations", "no such option", "did you mean `robust.rotations`", registered(options={"rotations": 100})),
    Case("axis in upper case", "INVALID_OPTIONS", 0, "options.up_axis", "'x', 'y' or 'z'", "docs/api.md", registered(options={"up_axis": "Z"})),
    Case("start under another preset", "PRESET_UNSUITABLE", 0, "initial transform", "only the preset `robust`", "paper", registered(room(chair_pose()), chair(), options={"preset": "paper"}, initial_transform=chair_pose())),
    Case("no box", "INVALID_DETECTION", 0, "detection is null", "expected an object with a box", '"min"', registered(detection=None)),
    Case("JSON text for a box", "INVALID_DETECTION", 0, "detection is a text", "expected an object", '"min"', lambda: wrong.OrientedBox.from_dict('{"min": [0, 0, 0]}')),
    Case("a point for a box", "INVALID_DETECTION", 0, "detection", "expected", '"min"', registered(detection=[0.1, 0.2, 0.3])),
    Case("corners swapped", "INVALID_DETECTION", 0, r"detection\[1\]\[0\]", "expected more than min", "are swapped", registered(detection=([1, 1, 1], [0, 0, 0]))),
    Case("box in millimeters", "DETECTION_OUTSIDE_SCENE", 0, "units from the scene", "the scene reaches from", "millimeters", registered(detection={"center": [-560, -280, -240], "size": [550, 600, 510]})),
    Case("one size for all axes", "INVALID_DETECTION", 0, "detection.size", "expected", "docs/api.md|x, y, z", lambda: wrong.OrientedBox.from_center([0, 0, 0], 1.0)),
    Case("rotation of a plane", "INVALID_DETECTION", 0, "detection.rotation", "expected|3x3", "docs/api.md|xyzw|3x3", lambda: wrong.OrientedBox.from_center([0, 0, 0], [1, 1, 1], np.eye(2))),
    Case("dictionary for a box of Open3D", "INVALID_DETECTION", 0, "a dict is not a box of Open3D", "Give an OrientedBoundingBox", "from_dict", lambda: wrong.OrientedBox.from_open3d(BOX)),
    Case("one box for a batch", "INVALID_DETECTION", 0, "detections is a single box", "expected a list", r"\[box\]", batch(regnf.OrientedBox.from_dict(BOX))),
    Case("pair beyond the lists", "PAIR_UNKNOWN", 0, r"no pair \(0, 1\)", "1 objects", "start at 0", batch([BOX], pairs=[(0, 1)])),
    Case("pairs that are none", "PAIR_UNKNOWN", 0, "0 is not a pair", "pair of detection and object", r"Write for example \[\(0, 0\)", batch([BOX], pairs=[0, 0])),
    Case("batch by the other preset", "INVALID_OPTIONS", 0, "`paper`", "only the preset `robust`", "docs/api.md", batch([BOX], options={"preset": "paper"})),
    Case("search among nothing", "LIBRARY_EMPTY", 0, "library", "no objects", "at least one", lambda: wrong.search(ROOM, [], BOX)),
    Case("search in an empty folder", "LIBRARY_EMPTY", 0, "nothing", "it has no fields", "Give the folder", lambda: wrong.search(ROOM, "nothing", BOX)),
    Case("search by the other preset", "PRESET_UNSUITABLE", 0, "`paper`", "only the preset `robust`", "robust", lambda: wrong.search(ROOM, [CHAIR], BOX, {"preset": "paper"})),
    Case("search among a number", "NO_FIELD", 0, "the objects are a int", "list of fields", "Give a folder", lambda: wrong.search(ROOM, 3, BOX)),
    Case("fit into a mesh file", "INVALID_OPTIONS", 0, "chair.glb", "ends in .safetensors", "Write chair.safetensors", lambda: wrong.fit(CHAIR, "chair.glb")),
    Case("fit into a missing folder", "FILE_NOT_FOUND", 0, "far", "no such folder", "mkdir -p", lambda: wrong.fit(CHAIR, "far/away.safetensors")),
    Case("fit with an option misspelled", "INVALID_OPTIONS", 0, "options.iteration", "no such option", "Did you mean `iterations`", lambda: wrong.fit(chair(), "out.safetensors", {"iteration": 5})),
    Case("fit of a mesh that is not there", "FILE_NOT_FOUND", 0, "chair.glb", "no such file", "Did you mean|Check the path", lambda: wrong.fit("chair.glb", "out.safetensors")),
    Case("render with text for options", "INVALID_OPTIONS", 0, "options is a str", "expected a dictionary", "mode", lambda: wrong.render(ROOM, None, "surface")),
    Case("one edit alone", "EDIT_INVALID", 0, "edits", "must be a list", r"\[Removal", lambda: wrong.compose(ROOM, regnf.OrientedBox.from_dict(BOX))),
]  # fmt: skip


@parametrized(CASES)
def test_a_wrong_call(case: Case, folder: Path) -> None:
    with pytest.raises(regnf.RegnfError) as caught:
        case.how()
    assert caught.value.reason == case.reason
    case.check(f"{caught.value}\n{caught.value.hint or ''}")


def test_a_name_that_is_not_there() -> None:
    with pytest.raises(AttributeError, match="regist"):
        _ = wrong.regist


def test_results_that_cannot_be_saved(folder: Path) -> None:
    box = regnf.OrientedBox.from_dict(BOX)
    result = regnf.register(ROOM, CHAIR, box, {"up_axis": "z"}, clouds=False)
    with pytest.raises(regnf.RegnfError, match="no point clouds") as caught:
        result.save("out")
    assert "clouds=True" in str(caught.value.hint)

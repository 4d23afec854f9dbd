# ruff: noqa: E501 -- a mistake is one line of a table
"""Calls of the Python interface that a new user gets wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from regnf_core import OrientedBox, RegistrationOptions, RegnfError, open_field, register
from tests.core.analytic import chair, chair_pose, room
from tests.mistakes.case import Case, parametrized


def registered(box: object) -> Callable[[], object]:
    return lambda: register(room(chair_pose()), chair(), OrientedBox.from_dict(box))


CASES = [
    Case("field missing", "FILE_NOT_FOUND", 0, "rom.safetensors", "no such file", "Did you mean room.safetensors", lambda: open_field("rom.safetensors")),
    Case("folder of no run", "RUN_WITHOUT_CHECKPOINT", 0, "nothing", "checkpoint", "Give the folder of one training run", lambda: open_field(Path("nothing"))),
    Case("config of a run", "FORMAT_NOT_RECOGNIZED", 0, "config.yml", "expected a field", "step-000030000.ckpt", lambda: open_field("run/config.yml")),
    Case("box without a size", "INVALID_DETECTION", 0, "detection.size", "is missing", '"min"', registered({"center": [0, 0, 0]})),
    Case("misspelled member", "INVALID_DETECTION", 0, "detection.cnter", "not a member", "Did you mean `center`", registered({"cnter": [0, 0, 0], "size": [1, 1, 1]})),
    Case("quaternion of unknown order", "INVALID_DETECTION", 0, "detection.rotation", "unknown order", "xyzw.*wxyz", registered({"center": [0, 0, 0], "size": [1, 1, 1], "rotation": [0, 0, 0, 1]})),
    Case("millimeters", "DETECTION_OUTSIDE_SCENE", 0, "the box is .* units from", "the scene reaches from", "millimeters", registered({"center": [300, 400, 500], "size": [200, 200, 200]})),
    Case("JSON text for a box", "INVALID_DETECTION", 0, "detection is a text", "expected an object", '"min"', registered('{"min": [0, 0, 0]}')),
    Case("spelling of earlier versions", "INVALID_OPTIONS", 0, "options.optimisation", "no such option", "did you mean `optimization`", lambda: RegistrationOptions.from_dict({"optimisation": {}})),
    Case("option of another type", "INVALID_OPTIONS", 0, "options.robust.rotations", "valid integer", "docs/api.md", lambda: RegistrationOptions.from_dict({"robust": {"rotations": "many"}})),
]  # fmt: skip


@parametrized(CASES)
def test_a_wrong_call(case: Case, folder: Path) -> None:
    with pytest.raises(RegnfError) as caught:
        case.how()
    assert caught.value.reason == case.reason
    case.check(f"{caught.value}\n{caught.value.hint or ''}")

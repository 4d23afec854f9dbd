"""What the worker's engine hands to regnf_core, with a double in its place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from regnf_core.options import RegistrationOptions
from regnf_worker.engine import CoreEngine

START = [[0.0, -2.0, 0.0, 0.5], [2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, -1.0], [0.0, 0.0, 0.0, 1.0]]
REQUEST: dict[str, Any] = {
    "detection": {"center": [0, 0, 0], "size": [1, 1, 1], "rotation_quaternion_xyzw": [0, 0, 0, 1]},
    "options": RegistrationOptions().to_dict(),
    "seed": 3,
    "object": "b" * 64,
}


@pytest.mark.parametrize("start", [None, START])
def test_the_initial_transform_reaches_the_engine(start: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr("regnf_core.fields.build.open_field", lambda path, device: path.name)
    monkeypatch.setattr("regnf_core.registration.register", lambda *given: calls.append(given))
    monkeypatch.setattr("regnf_core.viewing.write_artifacts", lambda result, folder, **said: ["result.json"])
    request = REQUEST | {"initial_transform": start, "ground_truth": None}
    files = Path("scene"), Path("object")
    names = CoreEngine("cpu").register(*files, "the model", request, lambda phase, share: None, tmp_path)
    ((scene, obj, box, options, seed, _, warm),) = calls
    assert (scene, obj, seed, warm.object_model, names) == ("scene", "object", 3, "the model", ["result.json"])
    assert options == RegistrationOptions()
    assert box.size.tolist() == [1, 1, 1]
    assert (None if warm.T_object_scene is None else warm.T_object_scene.matrix().tolist()) == start


def test_requests_recorded_before_there_were_starts_still_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_core.fields.build.open_field", lambda path, device: path.name)
    monkeypatch.setattr("regnf_core.registration.register", lambda *given: None)
    monkeypatch.setattr("regnf_core.viewing.write_artifacts", lambda result, folder, **said: [])
    assert CoreEngine("cpu").register(Path("s"), Path("o"), None, REQUEST, lambda phase, share: None, tmp_path) == []

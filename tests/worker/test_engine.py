"""What the worker's engine hands to regnf_core, with a double in its place."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from regnf_core.field_notes import FieldNotes
from regnf_core.options import RegistrationOptions
from regnf_worker.engine import Candidate, Engine
from tests.requests import registration_request

START = [[0.0, -2.0, 0.0, 0.5], [2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, -1.0], [0.0, 0.0, 0.0, 1.0]]


@pytest.mark.parametrize(("start", "pictures"), [(None, True), (START, True), (None, False)])
def test_the_request_reaches_the_engine(
    start: Any, pictures: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []
    monkeypatch.setattr("regnf_core.fields.build.open_field", lambda path, device: path.name)
    monkeypatch.setattr("regnf_core.library.register", lambda *given: calls.append(given))
    written: list[Any] = []

    def write_result(result: Any, folder: Path, **said: Any) -> list[str]:
        written.append(said["fields"])
        return ["result.json"]

    monkeypatch.setattr("regnf_core.viewing.artifacts.write_result", write_result)
    asked: dict[str, Any] = {"seed": 3, "initial_transform": start, "pictures": pictures}
    request = registration_request("a" * 64, "b" * 64, options=RegistrationOptions(), **asked)
    files = Path("scene"), Path("object")
    notes = {"scene": FieldNotes("neus", None, ("SIGN_UNCERTAIN: perhaps",))}
    made = Engine("cpu").register(*files, "the model", request, lambda phase, share: None, tmp_path, notes)
    ((scene, obj, box, options, seed, _, initial, model, clouds),) = calls
    assert (scene, obj, seed, model, clouds) == ("scene", "object", 3, "the model", False)
    assert (made.names, "aligned.ply" in made.to_come) == (["result.json"], pictures)
    assert made.on_request == (("preview.png",) if pictures else ())
    assert written == [{"scene": notes["scene"], "object": FieldNotes()}]
    assert options == RegistrationOptions()
    assert box.size.tolist() == [1, 1, 1]
    assert (None if initial is None else initial.matrix().tolist()) == start


@pytest.mark.parametrize(("pictures", "apart"), [(True, True), (True, False), (False, True)])
def test_a_search_makes_clouds_for_its_pictures_alone(
    pictures: bool, apart: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the winner, once the result is out."""
    calls: list[Any] = []
    result = SimpleNamespace(camera=None, deciding="a surface" if apart else None)
    found = SimpleNamespace(ranking=[SimpleNamespace(name="c" * 64)], result=result)
    monkeypatch.setattr("regnf_core.fields.build.open_field", lambda path, device: path.name)
    monkeypatch.setattr("regnf_core.library.search_library", lambda *_, **how: calls.append(how) or found)
    monkeypatch.setattr("regnf_core.document.ranking_document", lambda *_: [])
    monkeypatch.setattr("regnf_core.viewing.artifacts.write_result", lambda *_, **__: ["result.json"])
    monkeypatch.setattr("regnf_core.library.with_late_clouds", lambda result, *given: given[:2])
    monkeypatch.setattr("regnf_core.viewing.artifacts.write_clouds", lambda result, _: list(result))
    request = registration_request("a" * 64, None, options=RegistrationOptions(), pictures=pictures)
    several = [Candidate(sha256 * 64, partial(Path, sha256), "a model") for sha256 in "bc"]
    made = Engine("cpu").search(Path("scene"), several, request, lambda phase, share: None, tmp_path, {})
    assert calls == [{"clouds": False}]
    assert (made.names, bool(made.to_come)) == (["result.json"], pictures)
    assert ("difference.ply" in made.to_come) == (pictures and apart)
    if pictures:
        assert made.finish() == ["scene", "c"]


def test_workers_share_the_memory_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.set_per_process_memory_fraction", shares.append)
    assert Engine.on("auto", 4) == Engine("cuda")
    assert Engine.on("cuda", 1) == Engine("cuda")
    assert Engine.on("cpu", 4) == Engine("cpu")
    assert shares == [0.25]

"""Object models: made once a field, kept beside it, made again when they do not read; and searches through them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pytest
from redis import Redis

from regnf_core.errors import FieldFormatError, NoSurfaceError
from regnf_core.library_entries import EntryNotes
from regnf_core.options import RegistrationOptions
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.settings import Settings
from regnf_worker import models
from regnf_worker.attempt import run_attempt
from regnf_worker.engine import Candidate, Engine, Made
from regnf_worker.models import Context, is_unmodeled_entry, model_entry, model_key
from tests.requests import request_record
from tests.worker.doubles import context_over

SCENE, CHAIR, TABLE, AIR = ("a" * 64, "b" * 64, "c" * 64, "d" * 64)
SYMMETRY = {"order": 2, "axis": [0.0, 0.0, 1.0], "continuous": False}


@dataclass
class ModelEngine:
    """Models are the field's bytes behind a word; a field of air has none."""

    made: list[bytes] = field(default_factory=list)
    registered: list[Any] = field(default_factory=list)
    searched: list[Sequence[Candidate]] = field(default_factory=list)
    notes: list[Any] = field(default_factory=list)
    while_making: Any = None

    def describe(self) -> dict[str, Any]:
        return {"version": "models", "device": "none"}

    def register(self, *given: Any) -> Made:
        _, _, model, _, _, folder, notes = given
        self.registered.append(model)
        self.notes.append(notes)
        (folder / "result.json").write_text("{}")
        return Made(["result.json"])

    def search(self, *given: Any) -> Made:
        _, candidates, _, _, folder, _ = given
        self.searched.append(candidates)
        opened = [one.open().read_bytes().decode() for one in candidates]
        (folder / "result.json").write_text(json.dumps(opened))
        return Made(["result.json"])

    def make_model(self, field: Path, options: RegistrationOptions, target: Path) -> None:
        data = field.read_bytes()
        self.made.append(data)
        if self.while_making is not None:
            self.while_making()
        if data == b"air":
            raise NoSurfaceError("nothing but air", reason="NO_SURFACE_IN_OBJECT")
        target.write_bytes(b"model of " + data)

    def read_model(self, path: Path) -> bytes:
        data = path.read_bytes()
        if not data.startswith(b"model of "):
            raise FieldFormatError("damaged", reason="OBJECT_MODEL_INVALID")
        return data

    def symmetry(self, model: bytes) -> dict[str, Any]:
        return SYMMETRY


@pytest.fixture
def context(tmp_path: Path, any_redis: Redis) -> Context:
    made = context_over(any_redis, Settings(state_dir=tmp_path, heartbeat_s=0.05))
    for sha256, data in ((SCENE, b"room"), (CHAIR, b"chair"), (TABLE, b"table"), (AIR, b"air")):
        add_field(made, sha256, data)
    return made


def add_field(context: Context, sha256: str, data: bytes) -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(sha256, "validating", len(data), now, now))
    context.records.update_field(sha256, state="ready")
    context.blobs.put(f"fields/{sha256}/field.safetensors", data)


def run(context: Context, engine: ModelEngine, job_id: str, **request: Any) -> JobRecord:
    now = context.records.now()
    candidates = request.get("candidates")
    asked = request_record(
        SCENE,
        request.get("object"),
        options=RegistrationOptions.from_dict(request.get("options", {})),
        candidates=None if candidates is None else tuple(candidates),
    )
    context.records.create_job(JobRecord(job_id, "registration", "accepted", asked, {}, now, now), 10)
    run_attempt(context, job_id, 1, "w", lambda: cast(Engine, engine))
    record = context.records.get_job(job_id)
    assert record is not None
    return record


def symmetry_of(context: Context, sha256: str) -> Any:
    record = context.records.get_field(sha256)
    assert record is not None
    return record.symmetry


def test_the_first_job_makes_the_model_and_the_next_one_finds_it(context: Context) -> None:
    engine = ModelEngine()
    assert run(context, engine, "j1", object=CHAIR).status == "successful"
    assert run(context, engine, "j2", object=CHAIR).status == "successful"
    assert engine.made == [b"chair"]
    assert engine.registered == [b"model of chair"] * 2
    with context.blobs.open(model_key(CHAIR)) as file:
        assert file.read() == b"model of chair"
    assert symmetry_of(context, CHAIR) == SYMMETRY
    assert symmetry_of(context, SCENE) is None


def test_a_damaged_model_is_made_again_and_replaced(context: Context) -> None:
    engine = ModelEngine()
    context.blobs.put(model_key(CHAIR), b"half a mod")
    assert run(context, engine, "j1", object=CHAIR).status == "successful"
    assert (engine.made, engine.registered) == ([b"chair"], [b"model of chair"])
    with context.blobs.open(model_key(CHAIR)) as file:
        assert file.read() == b"model of chair"


def test_a_model_of_an_older_engine_is_left_alone(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = ModelEngine()
    context.blobs.put(model_key(CHAIR), b"model of an older engine")
    monkeypatch.setattr(models, "ENGINE_REVISION", models.ENGINE_REVISION + 1)
    assert run(context, engine, "j1", object=CHAIR).status == "successful"
    assert engine.registered == [b"model of chair"]


def test_the_published_method_needs_no_model(context: Context) -> None:
    engine = ModelEngine()
    assert run(context, engine, "j1", object=CHAIR, options={"preset": "paper"}).status == "successful"
    assert (engine.made, engine.registered) == ([], [None])
    assert not context.blobs.exists(model_key(CHAIR))


def test_a_model_of_other_options_is_neither_taken_nor_kept(context: Context) -> None:
    engine = ModelEngine()
    context.blobs.put(model_key(CHAIR), b"model of the usual chair")
    finer = {"robust": {"object_samples": 5000}}
    assert run(context, engine, "j1", object=CHAIR, options=finer).status == "successful"
    assert engine.registered == [b"model of chair"]
    with context.blobs.open(model_key(CHAIR)) as file:
        assert file.read() == b"model of the usual chair"
    assert symmetry_of(context, CHAIR) is None


@pytest.mark.parametrize("again", [False, True])
def test_nothing_is_kept_of_a_field_that_was_deleted_meanwhile(context: Context, again: bool) -> None:
    def delete() -> None:
        context.records.delete_field(CHAIR)
        context.blobs.delete_prefix(f"fields/{CHAIR}")
        if again:
            add_field(context, CHAIR, b"the same bytes, described as another function")

    engine = ModelEngine(while_making=delete)
    assert run(context, engine, "j1", object=CHAIR).status == "successful"
    assert not context.blobs.exists(model_key(CHAIR))
    if again:
        assert symmetry_of(context, CHAIR) is None


def test_a_search_gets_every_candidate_with_its_model(context: Context) -> None:
    engine = ModelEngine()
    run(context, engine, "j1", object=TABLE)
    assert run(context, engine, "j2", candidates=[CHAIR, TABLE, AIR]).status == "successful"
    assert engine.made == [b"table", b"chair", b"air"]
    (candidates,) = engine.searched
    assert [(one.sha256, one.model, one.fault) for one in candidates] == [
        (CHAIR, b"model of chair", None),
        (TABLE, b"model of table", None),
        (AIR, None, "NO_SURFACE_IN_OBJECT"),
    ]
    with context.blobs.open("jobs/j2/1/result.json") as file:
        assert json.load(file) == ["chair", "table", "air"], "each candidate opens its own field"


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"object": AIR}, "NO_SURFACE_IN_OBJECT"),
        ({"candidates": [AIR]}, "NO_SURFACE_IN_OBJECT"),
        ({"candidates": [CHAIR, TABLE]}, "FIELD_NOT_FOUND"),
    ],
)
def test_air_is_no_object_and_what_is_gone_is_told(context: Context, asked: dict[str, Any], reason: str) -> None:
    context.records.delete_field(TABLE)
    engine = ModelEngine()
    failed = run(context, engine, "j1", **asked)
    assert (failed.status, (failed.error or {}).get("reason")) == ("failed", reason)
    assert engine.searched == []


def test_a_search_stops_between_models_when_it_is_cancelled(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_worker.attempt._REPORT_EVERY_S", 0.0)  # every report asks the record
    engine = ModelEngine(while_making=lambda: context.records.request_cancel("j1"))
    assert run(context, engine, "j1", candidates=[CHAIR, TABLE, AIR]).status == "dismissed"
    assert engine.made == [b"chair"]
    assert engine.searched == []


def test_what_the_imports_said_reaches_the_result_and_the_job(context: Context) -> None:
    report = {"family": "neus", "warnings": ["TRUNCATION_ASSUMED: 8 voxels", "TRUNCATION_ASSUMED: again", "x" * 99]}
    context.records.update_field(SCENE, report=report)
    used = {"trainer": "neus", "files": ["config.conf"], "used": {"scale": 3.0}}
    context.records.update_field(CHAIR, report={"warnings": "no list", "settings": used})
    engine = ModelEngine()
    record = run(context, engine, "j1", object=CHAIR)
    assert record.inputs["warnings"] == {"scene": ["TRUNCATION_ASSUMED", "x" * 64]}
    (notes,) = engine.notes
    assert notes["scene"].to_dict() == {**report, "settings": None, "assumed": []}
    assert notes[CHAIR].to_dict() == {"family": None, "settings": used, "warnings": [], "assumed": []}
    assert run(context, engine, "j2", candidates=[CHAIR, TABLE]).inputs["warnings"] == record.inputs["warnings"]


def entered(context: Context, sha256: str) -> None:
    known = context.records.get_field(sha256)
    assert known is not None
    context.records.set_entry(known, EntryNotes.checked(f"entry {sha256[0]}"))


def test_the_model_of_a_librarys_object_is_there_before_its_first_search(context: Context) -> None:
    engine = ModelEngine()
    assert not is_unmodeled_entry(context.records, CHAIR, 1)
    entered(context, CHAIR)
    assert is_unmodeled_entry(context.records, CHAIR, 1)
    assert not is_unmodeled_entry(context.records, CHAIR, 2)
    model_entry(context, CHAIR, cast(Engine, engine))
    assert (engine.made, symmetry_of(context, CHAIR)) == ([b"chair"], SYMMETRY)
    assert not is_unmodeled_entry(context.records, CHAIR, 1)
    assert run(context, engine, "j1", candidates=[CHAIR, TABLE]).status == "successful"
    assert engine.made == [b"chair", b"table"]


def test_an_entry_that_is_no_object_stays_without_a_model(context: Context) -> None:
    entered(context, AIR)
    model_entry(context, AIR, cast(Engine, ModelEngine()))
    assert symmetry_of(context, AIR) is None
    assert not context.blobs.exists(model_key(AIR))

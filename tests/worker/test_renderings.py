"""Rendering jobs take the way of registrations: published whole or not at all, with the edited scene a field."""

from __future__ import annotations

from hashlib import sha256
from typing import Any

import pytest

from regnf_core.rendering.request import RenderRequest
from regnf_state.manifest import EDITED_FIELD, read_manifest
from regnf_state.ownership import reference_of
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.registration_request import RenderingRequest
from regnf_worker.attempt import run_attempt
from regnf_worker.models import Context
from regnf_worker.settle import ChildExit, settle_registration
from tests.worker.doubles import context_over, job
from tests.worker.tiny_engine import TinyEngine

SCENE, OBJECT = "a" * 64, "b" * 64
UNIT = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
DIGEST = sha256(b"s").hexdigest()
"""Of the edited scene that the tiny engine makes."""


def accept(context: Context, do: str = "succeed", owner: str = "anonymous", **changes: Any) -> None:
    """Record a rendering whose only edit's name tells the tiny engine what to do."""
    now = context.records.now()
    for name, data in ((SCENE, b"s"), (OBJECT, b"o")):
        reference = reference_of(owner, name)
        context.records.create_field(FieldRecord(reference, "ready", 1, now, now))
        context.blobs.put(f"fields/{reference}/field.safetensors", data)
    edit = {"kind": "substitution", "object": OBJECT, "T_object_scene": UNIT, "name": do}
    asked = RenderingRequest(SCENE, RenderRequest.from_dict({"edits": [edit]} | changes)).owned_by(owner)
    context.records.create_job(JobRecord("j1", "render", "accepted", asked.to_record(), {}, now, now), 10)


def run(context: Context, attempt: int = 1) -> None:
    run_attempt(context, "j1", attempt, "w", TinyEngine)


@pytest.mark.parametrize("owner", ["anonymous", "alice"])
def test_a_rendering_opens_its_owners_fields(context: Context, owner: str) -> None:
    accept(context, owner=owner)
    run(context)
    assert (job(context).status, job(context).verdict, job(context).owner) == ("successful", None, owner)
    manifest = read_manifest(context.blobs, "j1")
    assert manifest is not None
    with context.blobs.open(manifest.key("frame-0000.png")) as file:
        assert file.read() == b"so"
    assert set(manifest.served()) == {"frame-0000.png", "result.json"}


@pytest.mark.parametrize(("do", "reason"), [("refuse", "NO_SURFACE_IN_DETECTION"), ("exhaust", "OUT_OF_MEMORY")])
def test_a_rendering_that_fails_leaves_nothing(context: Context, do: str, reason: str) -> None:
    accept(context, do, outputs=["field"])
    run(context)
    error = job(context).error
    assert error is not None
    assert (job(context).status, error["reason"]) == ("failed", reason)
    assert list(context.blobs.list("jobs")) == []
    assert context.records.get_field(DIGEST) is None


def test_a_cancelled_rendering_leaves_nothing(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    accept(context, "cancel", outputs=["field"])

    def cancel(engine: TinyEngine, report: Any) -> None:
        context.records.request_cancel("j1")
        engine.iterate(report)

    monkeypatch.setattr(TinyEngine, "cancel", cancel, raising=False)
    run(context)
    assert job(context).status == "dismissed"
    assert list(context.blobs.list("jobs")) == []
    assert context.records.get_field(DIGEST) is None


def test_a_request_that_cannot_be_read_fails_alone(context: Context) -> None:
    accept(context)
    record = job(context)
    context.records.delete_job("j2")
    now = context.records.now()
    context.records.create_job(JobRecord("j2", "hologram", "accepted", record.request, {}, now, now), 10)
    run_attempt(context, "j2", 1, "w", TinyEngine)
    other = context.records.get_job("j2")
    assert other is not None
    assert other.error is not None
    assert other.error["reason"] == "RECORD_UNREADABLE"


@pytest.mark.parametrize("owner", ["anonymous", "alice"])
def test_the_edited_scene_is_imported_as_its_owners_field(context: Context, owner: str) -> None:
    accept(context, owner=owner, outputs=["field"])
    run(context)
    reference = reference_of(owner, DIGEST)
    field = context.records.get_field(reference)
    assert field is not None
    assert (field.state, field.bytes, field.owner) == ("validating", 1, owner)
    with context.blobs.open(f"fields/{reference}/original") as file:
        assert file.read() == b"s"
    assert context.queue.holds_import(reference, 1)


def test_a_process_that_died_after_publishing_has_its_field_imported(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    accept(context, outputs=["field"])

    def die(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("regnf_worker.attempt.keep_edited_field", die)
        with pytest.raises(KeyboardInterrupt):
            run(context)
    assert context.records.get_field(DIGEST) is None
    settle_registration(context, "j1", 1, "w", ChildExit(signal=9))
    assert job(context).status == "successful"
    assert context.queue.holds_import(DIGEST, 1)


def test_a_field_that_is_there_already_stays_as_it_is(context: Context) -> None:
    accept(context, outputs=["field"])
    now = context.records.now()
    known, _ = context.records.create_field(FieldRecord(DIGEST, "ready", 1, now, now, label="mine"))
    run(context)
    assert context.records.get_field(DIGEST) == known
    assert not context.blobs.exists(f"fields/{DIGEST}/original")


def test_without_room_the_artifact_is_all_there_is(any_redis: Any, context: Context) -> None:
    tight = context_over(any_redis, context.settings.model_copy(update={"quota_fields": 2}))
    accept(tight, outputs=["field"])
    run(tight)
    assert job(tight).status == "successful"
    assert tight.records.get_field(DIGEST) is None
    assert not tight.blobs.exists(f"fields/{DIGEST}/original")
    manifest = read_manifest(tight.blobs, "j1")
    assert manifest is not None
    assert EDITED_FIELD in manifest.served()

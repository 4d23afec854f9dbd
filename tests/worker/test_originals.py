"""Uploads that stay after their import: which, for how long, and what else goes with them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from regnf_core.errors import FieldFormatError
from regnf_state.records import FieldRecord
from regnf_state.room import Originals
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from tests.stores import ShiftedRecords
from tests.worker.doubles import SHA, begin_import, field
from tests.worker.tiny_engine import tiny_importer

ORIGINAL = f"fields/{SHA}/original"
CONFIG = b"method: neus\n"


def refusing(reason: str) -> Any:
    def importer(*_: Any) -> dict[str, Any]:
        raise FieldFormatError("which one is it?", reason=reason)

    return importer


def keeping(context: Context, **settings: Any) -> Context:
    return replace(context, settings=context.settings.model_copy(update=settings))


def keys(context: Context) -> set[str]:
    return set(context.blobs.list(""))


@pytest.mark.parametrize(
    ("choice", "reason", "kept"),
    [
        ("questions", "LATENT_MISSING", True),
        ("questions", "FIELD_IMPLAUSIBLE", True),
        ("all", "LAYOUT_AMBIGUOUS", True),
        ("none", "LATENT_MISSING", False),
        ("questions", "TENSOR_NOT_FINITE", False),
        ("all", "IMPORT_TIMEOUT", False),
    ],
)
def test_of_a_rejected_field_the_upload_stays_where_a_description_may_help(
    context: Context, choice: str, reason: str, kept: bool
) -> None:
    begin_import(context)
    run_import_attempt(keeping(context, keep_originals=choice), SHA, 1, "w", refusing(reason))
    assert (field(context).state, (field(context).error or {})["reason"]) == ("rejected", reason)
    assert keys(context) == ({ORIGINAL} if kept else set())
    assert (field(context).original_until is not None) == kept
    assert context.records.stored("anonymous") == ((1, 1) if kept else (0, 0))
    again = FieldRecord(SHA, "validating", 1, 0.0, 0.0)
    assert set(context.records.known_rejection(again) or {}).isdisjoint({"original_until"})


@pytest.mark.parametrize("choice", ["questions", "all"])
def test_of_a_ready_field_the_upload_stays_if_the_setting_says_so(context: Context, choice: str) -> None:
    begin_import(context)
    run_import_attempt(keeping(context, keep_originals=choice), SHA, 1, "w", tiny_importer)
    assert field(context).state == "ready"
    assert (ORIGINAL in keys(context)) == (field(context).original_until is not None) == (choice == "all")


def uploaded_with_settings(context: Context) -> str:
    """A field that waits for its import, and the key of its settings."""
    digest = hashlib.sha256(CONFIG).hexdigest()
    now = context.records.now()
    said = {"sign": -1, "settings": {"name": "config.yml", "sha256": digest, "bytes": len(CONFIG)}}
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now, description=said))
    context.blobs.put(ORIGINAL, b"f")
    context.blobs.put(f"fields/{SHA}/settings-{digest}", CONFIG)
    return f"fields/{SHA}/settings-{digest}"


def test_settings_reach_the_import_under_their_own_name_and_go_with_the_upload(context: Context) -> None:
    uploaded_with_settings(context)
    seen: list[Any] = []

    def importer(*given: Any) -> dict[str, Any]:
        seen.append((given[2], given[3].name, given[3].read_bytes()))
        return tiny_importer(*given)

    run_import_attempt(context, SHA, 1, "w", importer)
    assert seen == [({"sign": -1}, "config.yml", CONFIG)]
    assert {key.rpartition("/")[2] for key in keys(context)} == {"field.safetensors", "report.json"}


def test_settings_stay_with_the_upload(context: Context) -> None:
    settings = uploaded_with_settings(context)
    run_import_attempt(context, SHA, 1, "w", refusing("TRUNCATION_UNKNOWN"))
    assert keys(context) == {ORIGINAL, settings}
    assert context.records.stored("anonymous") == (1, 1 + len(CONFIG))


def test_what_was_made_of_the_field_before_goes_with_a_new_import(context: Context) -> None:
    begin_import(context)
    for name in ("object-model-1.safetensors", "preview.png", "report.json"):
        context.blobs.put(f"fields/{SHA}/{name}", b'{"description": {"sign": -1}, "report": {}}')
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    assert {key.rpartition("/")[2] for key in keys(context)} == {"field.safetensors", "report.json"}


def kept(context: Context, number: int, size: int = 10) -> str:
    """An upload that was rejected with a question, the ``number``-th."""
    sha256 = f"{number:064x}"
    now = context.records.now()
    context.records.create_field(FieldRecord(sha256, "validating", size, now, now))
    context.blobs.put(f"fields/{sha256}/original", b"." * size)
    run_import_attempt(context, sha256, 1, "w", refusing("LATENT_MISSING"))
    return f"fields/{sha256}/original"


def originals(context: Context, **settings: Any) -> Originals:
    return Originals(context.records, context.blobs, keeping(context, **settings).settings)


def test_uploads_go_when_their_time_is_over(context: Context) -> None:
    assert isinstance(context.records, ShiftedRecords)
    first = kept(context, 1)
    context.records.ahead_s = 3600
    second = kept(context, 2)
    assert originals(context).trim("anonymous") == 0
    context.records.ahead_s = 6 * 3600 + 60
    assert originals(context).trim("anonymous") == 1
    assert keys(context) == {second}
    gone = context.records.get_field(first.split("/")[1])
    assert gone is not None
    assert (gone.state, gone.original_until, (gone.error or {})["reason"]) == ("rejected", None, "LATENT_MISSING")
    assert context.records.stored("anonymous") == (1, 10)


def test_the_oldest_go_beyond_what_is_kept(context: Context) -> None:
    assert isinstance(context.records, ShiftedRecords)
    made = []
    for number in range(4):
        context.records.ahead_s = number
        made.append(kept(context, number))
    assert originals(context, keep_originals_bytes=25).trim("anonymous") == 2
    assert keys(context) == set(made[2:])
    assert originals(context).bytes_of("anonymous") == 20
    assert originals(context).free("anonymous")
    assert keys(context) == {made[3]}
    assert originals(context).free("anonymous")
    assert not originals(context).free("anonymous")
    assert keys(context) == set()


def test_an_upload_that_is_sent_again_in_between_stays(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    place = kept(context, 1)
    change = context.records.update_field

    def and_sent_again(sha256: str, **how: Any) -> FieldRecord:
        changed = change(sha256, **how)
        context.records.create_field(replace(changed, state="validating", error=None))
        return changed

    monkeypatch.setattr(context.records, "update_field", and_sent_again)
    assert originals(context).free("anonymous")
    assert keys(context) == {place}


def test_cameras_reach_the_import_beside_settings_and_go_with_the_upload(context: Context) -> None:
    settings, poses = uploaded_with_settings(context), b"0 0 0 0 0 0 0 1\n"
    digest = hashlib.sha256(poses).hexdigest()
    known = context.records.get_field(SHA)
    assert known is not None
    said = {**known.description, "cameras_file": {"name": "poses.txt", "sha256": digest, "bytes": len(poses)}}
    context.records.update_field(SHA, description=said)
    context.blobs.put(f"fields/{SHA}/settings-{digest}", poses)
    seen: list[Any] = []

    def importer(
        upload: Path, folder: Path, description: dict[str, Any], settings: Path | None, cameras: Path | None = None
    ) -> dict[str, Any]:
        assert cameras is not None
        seen.append((description, cameras.name, cameras.read_bytes()))
        return tiny_importer(upload, folder, description, settings)

    run_import_attempt(context, SHA, 1, "w", importer)
    assert seen == [({"sign": -1}, "poses.txt", poses)]
    assert not {settings, f"fields/{SHA}/settings-{digest}"} & keys(context)

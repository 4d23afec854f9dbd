"""One attempt at an import, against stores in memory."""

import json
from typing import Any

import pytest

from regnf_core.errors import FieldFormatError
from regnf_worker.imports import run_import_attempt
from regnf_worker.models import Context
from regnf_worker.settle import ChildExit, settle_import
from tests.worker.doubles import SHA, begin_import, field
from tests.worker.tiny_engine import tiny_importer


def test_of_two_deliveries_of_an_import_one_does_the_work(context: Context) -> None:
    begin_import(context)
    context.records.set_if_absent(f"import:{SHA}:1", "other", 60)
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    settle_import(context, SHA, 1, "w", ChildExit(signal=9))
    assert field(context).state == "validating"
    run_import_attempt(context, SHA, 1, "other", tiny_importer)
    assert field(context).state == "ready"


def test_an_import_that_died_after_its_work_is_not_done_again(context: Context) -> None:
    begin_import(context)
    context.blobs.put(
        f"fields/{SHA}/report.json", json.dumps({"description": {}, "report": {"family": "found before"}}).encode()
    )
    context.blobs.delete(f"fields/{SHA}/original")
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    assert (field(context).state, field(context).report["family"]) == ("ready", "found before")


def test_a_field_deleted_while_it_is_imported_leaves_nothing(context: Context) -> None:
    begin_import(context)

    def importer(*given: Any) -> dict[str, Any]:
        context.records.delete_field(SHA)
        return tiny_importer(*given)

    run_import_attempt(context, SHA, 1, "w", importer)
    assert list(context.blobs.list("")) == []


def test_an_upload_after_a_deletion_owes_nothing_to_the_import_before_it(context: Context) -> None:
    begin_import(context)

    def importer(*given: Any) -> dict[str, Any]:
        context.records.delete_field(SHA)
        begin_import(context)
        return tiny_importer(*given)

    run_import_attempt(context, SHA, 1, "w", importer)
    settle_import(context, SHA, 1, "w", ChildExit())
    assert field(context).state == "validating"
    assert list(context.blobs.list("")) == [f"fields/{SHA}/original"]
    run_import_attempt(context, SHA, field(context).attempt, "other", tiny_importer)
    assert field(context).state == "ready"


@pytest.mark.parametrize(
    ("reason", "setting"),
    [
        ("IMPORT_TIMEOUT", "REGNF_IMPORT_TIMEOUT_S"),
        ("IMPORT_TOO_COSTLY", "REGNF_IMPORT_WORK_S"),
        ("IMPORT_OUT_OF_MEMORY", "REGNF_IMPORT_MEMORY_BYTES"),
        ("FIELD_NOT_RECOGNIZED", None),
    ],
)
def test_a_limit_is_told_with_its_setting_and_is_not_remembered(
    context: Context, reason: str, setting: str | None
) -> None:
    begin_import(context)
    before = field(context)

    def importer(*_: object, **__: object) -> dict[str, object]:
        raise FieldFormatError("longer than 120 s", reason=reason)

    run_import_attempt(context, SHA, 1, "w", importer)
    error = field(context).error
    assert error is not None
    assert error["detail"] == ("longer than 120 s" if setting is None else f"longer than 120 s ({setting})")
    assert setting is None or setting in error["hint"]
    assert (context.records.known_rejection(before) is None) == (setting is not None)


def test_a_report_for_another_description_does_not_count(context: Context) -> None:
    begin_import(context)
    standing = {"description": {"contraction": "linf"}, "report": {"family": "found before"}}
    context.blobs.put(f"fields/{SHA}/report.json", json.dumps(standing).encode())
    run_import_attempt(context, SHA, 1, "w", tiny_importer)
    assert (field(context).state, field(context).report["family"]) == ("ready", "tiny")

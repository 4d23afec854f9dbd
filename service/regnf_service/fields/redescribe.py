"""Another description of a field that is held: its bytes are imported again, if they are still there."""

from __future__ import annotations

from typing import Any

from regnf_core.importing.upload_description import UploadDescription
from regnf_service.fields.ingest import check_workers, function_of
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.records import CAMERAS, SETTINGS, FieldRecord, StaleAttemptError
from regnf_state.room import original_key, settings_key


def redescribe(services: Services, caller: str, known: FieldRecord, said: UploadDescription, label: str | None) -> bool:
    """Have the field imported as another function, or change its label alone. Whether it is imported.

    Raises Problem FIELD_VALIDATING, FIELD_IN_USE, FIELD_BYTES_GONE, QUOTA_ACTIVE_JOBS, CONFLICT, and
    RecordsFullError.
    """
    function = function_of(said) | {
        name: value for name, value in known.description.items() if name in (SETTINGS, CAMERAS)
    }
    if function == known.description:
        if label != known.label:
            _changed(services, known, label)
        return False
    if known.state == "validating":
        raise Problem("FIELD_VALIDATING", headers={"Retry-After": "1"})
    _require_unused(services, known)
    _require_bytes(services, known)
    check_workers(services, caller)
    services.room.make(caller)
    _import_anew(services, known, function, label)
    return True


def _changed(services: Services, known: FieldRecord, label: str | None) -> None:
    try:
        services.records.update_field(known.sha256, attempt=known.attempt, label=label)
    except StaleAttemptError as error:
        raise Problem("CONFLICT") from error


def _require_unused(services: Services, field: FieldRecord) -> None:
    if next(iter(services.records.jobs_using_field(field.sha256)), None) is not None:
        raise Problem("FIELD_IN_USE")


def _require_bytes(services: Services, field: FieldRecord) -> None:
    keys = [original_key(field.sha256)]
    keys += [settings_key(field.sha256, file.sha256) for file in field.beside]
    if field.original_until is None or not all(map(services.blobs.exists, keys)):
        raise Problem("FIELD_BYTES_GONE")


def _import_anew(services: Services, known: FieldRecord, function: dict[str, Any], label: str | None) -> None:
    """The record changes first. A job that was accepted in between keeps its function: then it changes back."""
    try:
        field = services.records.reimport_field(known, function, label)
    except StaleAttemptError as error:
        raise Problem("CONFLICT") from error
    try:
        _require_unused(services, field)
        if not services.blobs.exists(original_key(field.sha256)):  # they may have been let go of in between
            raise Problem("FIELD_BYTES_GONE")
    except Problem:
        services.records.undo_reimport(known, field.attempt)
        raise
    services.queue.enqueue_import(field.sha256, field.attempt)


# The mesh and the picture of a field: a worker makes them when it has time, first those that somebody asks for.


def missing_view(services: Services, record: FieldRecord) -> Problem:
    """What is to be said of a picture or mesh that is not there. Blocking.

    With Retry-After while a worker is to make it, which it does sooner for this call.
    """
    if record.views != "pending":
        return Problem("FIELD_VIEW_NOT_FOUND")
    services.records.draw_next(record.sha256)
    return Problem("FIELD_VIEW_NOT_FOUND", headers={"Retry-After": "1"})

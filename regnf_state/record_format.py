"""How records are written and read by several releases: docs/adr/0010-versioned-records.md.

A document has a format, a whole number. Members that this release does not know are kept and written back. A document
of a later format, or one that is damaged, is unreadable: nothing is made of it, and nothing else suffers from it.
"""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from regnf_core.errors import InvalidInputError
from regnf_core.library_entries import EntryNotes
from regnf_state.records import FieldRecord, JobRecord, UnreadableRecordError

FORMAT = 1
"""Raised by a release whose documents an earlier one must not touch: another meaning, another status."""
_UNKNOWN = "unknown_members"
_NEW = ("library",)
"""Members that the release before this one does not know."""
LAST_TIME = 253402300800.0
"""The year 10000: what no calendar shows."""
_TIMES = ("created", "updated", "started", "finished", "heartbeat", "phase_since", "original_until")
_PROBLEM = {"type": str, "title": str, "status": int, "reason": str, "detail": str, "hint": str, "errors": list}
_READERS: dict[type[Any], TypeAdapter[Any]] = {kind: TypeAdapter(kind) for kind in (JobRecord, FieldRecord)}
_MEMBERS: dict[type[Any], frozenset[str]] = {
    kind: frozenset(one.name for one in fields(kind)) - {_UNKNOWN} for kind in (JobRecord, FieldRecord)
}
_Record = TypeVar("_Record", JobRecord, FieldRecord)


def document_of(record: JobRecord | FieldRecord) -> dict[str, Any]:
    """The members of a record as they are written: those that the release before this one knows, and newer ones where
    they say something. That release keeps what it does not know."""
    document = dict(vars(record))  # no copies of what is in them: a search names hundreds of fields
    for name in _NEW:
        if document.get(name, ...) is None:
            del document[name]
    document.update(document.pop(_UNKNOWN))
    return document


def encoded(record: JobRecord | FieldRecord) -> str:
    """The record as JSON."""
    return json.dumps(document_of(record), separators=(",", ":"))


def decoded(kind: type[_Record], name: str, text: bytes | str, format_: object = None) -> _Record:
    """The record of this name in a document. Raises UnreadableRecordError.

    ``format_``: of the document, as it is written; None for what was written before there were formats.
    """
    if format_ is not None:
        _check_format(name, format_)
    try:
        document = json.loads(text, parse_constant=_refuse)
        record: _Record = _READERS[kind].validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UnreadableRecordError(name, f"{where or 'it'}: {first['type']}") from error
    except (ValueError, RecursionError) as error:
        raise UnreadableRecordError(name, "it is not JSON") from error
    unknown = {member: document[member] for member in document.keys() - _MEMBERS[kind]}
    record = replace(record, unknown_members=unknown)
    _check(record, name)
    return record


def check_json_format(name: str, document: object) -> dict[str, Any]:
    """A document whose format is one of its members. Raises UnreadableRecordError unless this release can read it."""
    if not isinstance(document, dict):
        raise UnreadableRecordError(name, "it is not an object")
    _check_format(name, document.get("format", FORMAT))
    return document


def _check_format(name: str, value: object) -> None:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else str(value)
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise UnreadableRecordError(name, "its format is no number")
    if int(text) > FORMAT:
        raise UnreadableRecordError(name, f"it has format {text}, this release reads {FORMAT}", newer=True)


def _refuse(constant: str) -> None:
    """NaN and infinities, which no answer could tell."""
    raise ValueError(constant)


def _check(record: JobRecord | FieldRecord, name: str) -> None:
    """What the types do not say and every reader relies on."""
    if (record.id if isinstance(record, JobRecord) else record.sha256) != name:
        raise UnreadableRecordError(name, "it is the record of something else")
    times = [getattr(record, time, None) for time in _TIMES]
    if not all(time is None or (math.isfinite(time) and 0 <= time < LAST_TIME) for time in times):
        raise UnreadableRecordError(name, "a time is out of range")
    error: dict[str, Any] = record.error or {}
    if not all(isinstance(error[member], kind) for member, kind in _PROBLEM.items() if member in error):
        raise UnreadableRecordError(name, "error: a member has the wrong type")
    if isinstance(record, JobRecord):
        _check_request(record.request, name)
    elif record.library is not None:
        _check_entry(record.library, name)


def _check_entry(entry: dict[str, Any], name: str) -> None:
    added = entry.get("added")
    try:
        EntryNotes.from_dict(entry)
    except InvalidInputError as error:
        raise UnreadableRecordError(name, f"library: {error}") from error
    if not (isinstance(added, int | float) and math.isfinite(added) and 0 <= added < LAST_TIME):
        raise UnreadableRecordError(name, "library: a time is out of range")


def _check_request(request: dict[str, Any], name: str) -> None:
    named = [request.get("scene", ""), request.get("object") or ""]
    for several in ("candidates", "objects"):
        listed = request.get(several) or []
        named += listed if isinstance(listed, list) else [0]
    if not all(isinstance(one, str) for one in named):
        raise UnreadableRecordError(name, "request: a field is named by something else than a text")
    webhook = request.get("webhook", {"url": ""})
    if not (isinstance(webhook, dict) and isinstance(webhook.get("url"), str)):
        raise UnreadableRecordError(name, "request.webhook: no address")

"""The records that are the truth about fields and jobs, and the refusals of the store that keeps them.

A job's state machine is monotonic: accepted -> running -> successful | failed | dismissed. Every change names the
attempt it belongs to; a writer of an older attempt loses (StaleAttemptError). RQ is transport, never truth.
Times are the store's own: one clock for every machine that shares it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError

from regnf_core.errors import InvalidInputError
from regnf_core.library_entries import EntryNotes
from regnf_core.schema.closed import Closed
from regnf_state.ownership import ANONYMOUS, owner_of
from regnf_state.settings import Settings

JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
FieldState = Literal["validating", "ready", "rejected"]
ViewState = Literal["pending", "ready", "none"]
ACTIVE: frozenset[str] = frozenset({"accepted", "running"})
FINISHED: frozenset[str] = frozenset({"successful", "failed", "dismissed"})


class RecordError(Exception):
    """Base of the store's refusals."""


class QueueFullError(RecordError):
    """As many jobs are active as the service takes."""


class QuotaError(RecordError):
    """The owner has as much as it may have; ``reason`` says of what."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class RecordsFullError(RecordError):
    """The store keeps the room that it has left for what goes on already."""

    reason = "STORAGE_FULL"


class StaleAttemptError(RecordError):
    """The change came from an attempt that is no longer the current one, or from a state that forbids it."""


class UnreadableRecordError(RecordError):
    """What is held under ``name`` cannot be read. ``newer``: a later release has written it, and may read it again."""

    reason = "RECORD_UNREADABLE"

    def __init__(self, name: str, why: str, *, newer: bool = False) -> None:
        super().__init__(f"the record of {name} cannot be read: {why}")
        self.name = name
        self.why = why
        self.newer = newer


@dataclass(frozen=True)
class Quota:
    """The most that one owner may have; None: any number."""

    active_jobs: int | None = None
    share_jobs: bool = False
    """Without a number of active jobs: an owner may have as many as are left free for others."""
    imports: int | None = None
    """Those that wait or run."""
    fields: int | None = None
    stored_bytes: int | None = None


NO_QUOTA = Quota()


@dataclass(frozen=True)
class JobRecord(Closed):
    """One job. Times are seconds since the epoch; ``error`` is a problem object; ``version`` grows with each change."""

    id: str
    kind: str
    status: JobStatus
    request: dict[str, Any]
    inputs: dict[str, Any]
    created: float
    updated: float
    version: int = 1
    attempt: int = 1
    phase: str | None = None
    progress: float = 0.0
    started: float | None = None
    finished: float | None = None
    heartbeat: float | None = None
    cancel_requested: bool = False
    engine: dict[str, Any] = field(default_factory=dict)
    error: dict[str, Any] | None = None
    requeues: int = 0
    """How often this request was handed out again because its worker vanished, since it was last requested."""
    worker: str | None = None
    """Who claimed the attempt."""
    phase_since: float | None = None
    verdict: str | None = None
    """Of a successful job: what its result says."""
    probability: float | None = None
    level: str | None = None
    object_found: str | None = None
    """Of a successful search: the SHA-256 of the object that its result is about."""
    more_webhooks: list[str] = field(default_factory=list)
    """Addresses named by later requests for this job, which are told of its end as well."""

    @property
    def webhooks(self) -> list[str]:
        """All addresses that get the message about the job's end, in the order of the requests."""
        own = [self.request["webhook"]["url"]] if "webhook" in self.request else []
        return own + self.more_webhooks

    @property
    def owner(self) -> str:
        """The caller whose job it is: the owner of the scene."""
        return owner_of(self.request["scene"]) if "scene" in self.request else ANONYMOUS

    @property
    def is_of_batch(self) -> bool:
        """Whether a batch has started it."""
        return "batch" in self.inputs


CANDIDATES = "candidates"
"""In a rejected field's error: what its upload may be, each with its name, the entries of a description that choose it,
and whether its picture is stored for as long as the upload is kept."""
WARNINGS = "warnings"
"""In a job's inputs: what the imports of its fields have warned of."""
SETTINGS = "settings"
"""In a field's description: the file of settings that came with the upload. No description has such an entry."""


CAMERAS = "cameras_file"
"""The same of the file that says where its cameras stood."""
_BESIDE = (SETTINGS, CAMERAS)
RECORDING = "recording"
"""What the entry `as` of a recording's description says. No description that comes with a field says so."""


class SettingsFile(NamedTuple):
    """A file that came with an upload: a trainer's settings, or where cameras stood."""

    name: str
    sha256: str
    bytes: int


@dataclass(frozen=True)
class FieldRecord(Closed):
    """One field. ``sha256`` is its reference: the SHA-256 of the bytes that were uploaded, and its owner's name."""

    sha256: str
    state: FieldState
    bytes: int
    created: float
    updated: float
    version: int = 1
    label: str | None = None
    description: dict[str, Any] = field(default_factory=dict)
    """What the uploader said that the file does not: family, level mask ...; under SETTINGS and CAMERAS which files
    came with it."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the import found: family, bounds, parameters, plausibility, warnings."""
    error: dict[str, Any] | None = None
    attempt: int = 1
    """Grows each time the import starts again; fences off the writer of an older one."""
    requeues: int = 0
    """How often this upload was handed out again because its worker vanished."""
    symmetry: dict[str, Any] | None = None
    """The turns that carry the object onto itself, once a job has used the field as an object: see the contract."""
    library: dict[str, Any] | None = None
    """What its owner's library says of it: see ``regnf_state.record_store``. None: it is no entry of it."""
    original_until: float | None = None
    """Until when the upload is kept although its import has ended; None: it is not."""
    views: ViewState | None = None
    """Of a ready field: whether its mesh and picture are still to be made, are there, or cannot be made."""
    drawings: int = 0
    """How often the making of mesh and picture was begun."""

    @property
    def owner(self) -> str:
        """The caller whose field it is."""
        return owner_of(self.sha256)

    @property
    def said(self) -> dict[str, Any]:
        """The description without the files that came."""
        return {name: value for name, value in self.description.items() if name not in _BESIDE}

    @property
    def is_recording(self) -> bool:
        """Whether the upload is a recording: frames of a camera in place of a field."""
        return self.description.get("as") == RECORDING

    @property
    def settings(self) -> SettingsFile | None:
        """The settings that came with the upload."""
        return self._beside(SETTINGS)

    @property
    def cameras(self) -> SettingsFile | None:
        """The file of cameras that came with the upload."""
        return self._beside(CAMERAS)

    @property
    def beside(self) -> list[SettingsFile]:
        """The files that came with the upload."""
        return [file for file in map(self._beside, _BESIDE) if file is not None]

    def _beside(self, entry: str) -> SettingsFile | None:
        match self.description.get(entry):
            case {"name": str() as name, "sha256": str() as sha256, "bytes": int() as size}:
                return SettingsFile(name, sha256, size)
        return None

    def has_candidate_picture(self, number: int) -> bool:
        """Whether the ``number``-th candidate, counted from 1, has a picture."""
        asked = (self.error or {}).get(CANDIDATES, ()) if self.original_until is not None else ()
        return 0 < number <= len(asked) and asked[number - 1].get("picture") is True

    @property
    def upload_bytes(self) -> int:
        """The upload and the files that came with it."""
        return self.bytes + sum(file.bytes for file in self.beside)

    @property
    def kept_bytes(self) -> int:
        """What counts towards the quota: of a ready field, its upload or what the import made of it, if that is larger.

        A compressed upload may become a field a thousand times as large. Both count where both are kept.
        """
        made = self.report.get("field_bytes") if self.state == "ready" else None
        if not isinstance(made, int):
            return self.upload_bytes
        return self.upload_bytes + made if self.original_until is not None else max(self.bytes, made)


@dataclass(frozen=True)
class JobEvent:
    """One line of a job's event stream; ``id`` orders them and resumes a broken stream.

    ``name`` is ``status`` or ``progress``; ``data`` holds status, phase, progress, attempt, updated, error if failed.
    """

    id: str
    name: str
    data: dict[str, Any]


class JobNews(NamedTuple):
    """A job and its latest events. The record was read first: a finished record's events are all there."""

    record: JobRecord | None
    events: list[JobEvent]


# What each caller may have, as the settings say it.


def quota_of(settings: Settings) -> Quota:
    """The quota that holds for every caller."""
    return Quota(
        active_jobs=settings.quota_active_jobs,
        share_jobs=settings.needs_token,
        imports=settings.max_imports_per_caller,
        fields=settings.quota_fields,
        stored_bytes=settings.quota_stored_bytes,
    )


# How records are written and read. A document has a format, a whole number. A document of another format, or one that
# is damaged, is unreadable: nothing is made of it, and nothing else suffers from it (docs/adr/0010).

FORMAT = 1
"""Raised by a release whose documents an earlier one cannot read."""
LAST_TIME = 253402300800.0
"""The year 10000: what no calendar shows."""
_TIMES = ("created", "updated", "started", "finished", "heartbeat", "phase_since", "original_until")
_PROBLEM = {"type": str, "title": str, "status": int, "reason": str, "detail": str, "hint": str, "errors": list}
_READERS: dict[type[Any], TypeAdapter[Any]] = {kind: TypeAdapter(kind) for kind in (JobRecord, FieldRecord)}
_Record = TypeVar("_Record", JobRecord, FieldRecord)


def document_of(record: JobRecord | FieldRecord) -> dict[str, Any]:
    """The members of a record as they are written."""
    return dict(vars(record))  # no copies of what is in them: a search names hundreds of fields


def encoded(record: JobRecord | FieldRecord) -> str:
    return json.dumps(document_of(record), separators=(",", ":"))


def decoded(kind: type[_Record], name: str, text: bytes | str, format_: object = FORMAT) -> _Record:
    """The record of this name in a document of this format, as it is written. Raises UnreadableRecordError."""
    _check_format(name, format_)
    try:
        json.loads(text, parse_constant=_refuse)
        record: _Record = _READERS[kind].validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise UnreadableRecordError(name, f"{where or 'it'}: {first['type']}") from error
    except (ValueError, RecursionError) as error:
        raise UnreadableRecordError(name, "it is not JSON") from error
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
        raise UnreadableRecordError(name, "its format is not a number")
    if int(text) != FORMAT:
        message = f"it has format {text}; this release reads {FORMAT}"
        raise UnreadableRecordError(name, message, newer=int(text) > FORMAT)


def _refuse(constant: str) -> None:
    """NaN and infinities, which no answer could tell."""
    raise ValueError(constant)


def _check(record: JobRecord | FieldRecord, name: str) -> None:
    """What the types do not say and every reader relies on."""
    if (record.id if isinstance(record, JobRecord) else record.sha256) != name:
        raise UnreadableRecordError(name, "it is the record of another object")
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
        raise UnreadableRecordError(name, "request: the name of a field is not a text")
    webhook = request.get("webhook", {"url": ""})
    if not (isinstance(webhook, dict) and isinstance(webhook.get("url"), str)):
        raise UnreadableRecordError(name, "request.webhook: no address")

"""What a record may become: pure functions from one record to the next, shared by every record store."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from regnf_state.records import ACTIVE, FINISHED, FieldRecord, JobRecord, QuotaError, StaleAttemptError

MAX_WEBHOOKS = 16
"""How many addresses one job tells of its end."""
MAX_WEBHOOK_CHARACTERS = 4096
"""Of all of them together: a record of a finished job holds them."""
_KEPT_OF_REQUEST = frozenset({"scene", "webhook", "version"})

_MOVES: dict[str, frozenset[str]] = {
    "accepted": frozenset({"running", "failed", "dismissed"}),
    "running": frozenset({"successful", "failed", "dismissed"}),
}
_TOLD_BY_RESULT = frozenset({"verdict", "probability", "level", "object_found"})
_CHANGEABLE_IN_JOB = _TOLD_BY_RESULT | {"status", "phase", "progress", "engine", "error", "inputs", "worker"}
_CHANGEABLE_IN_FIELD = frozenset(
    {"state", "label", "description", "report", "error", "bytes", "symmetry", "original_until", "views", "drawings"}
)


def _refuse_unknown(changes: dict[str, Any], allowed: frozenset[str]) -> None:
    unknown = changes.keys() - allowed
    if unknown:
        raise TypeError(f"cannot change {', '.join(sorted(unknown))}")


def _require_attempt(record: JobRecord | FieldRecord, attempt: int) -> None:
    if record.attempt != attempt:
        raise StaleAttemptError(f"attempt {attempt} is not the current one, {record.attempt} is")


def changed_job(record: JobRecord, attempt: int, changes: dict[str, Any], now: float) -> JobRecord:
    """The job after ``changes`` by ``attempt``. Progress never falls; every change of status must be a move.

    Raises StaleAttemptError, and TypeError for an attribute that is not for changing.
    """
    _refuse_unknown(changes, _CHANGEABLE_IN_JOB)
    _require_attempt(record, attempt)
    status = changes.get("status", record.status)
    if "status" in changes and status not in _MOVES.get(record.status, frozenset()):
        raise StaleAttemptError(f"a job that is {record.status} cannot become {status}")
    if record.status in FINISHED:
        raise StaleAttemptError(f"a job that is {record.status} no longer changes")
    derived: dict[str, Any] = {}
    if "progress" in changes:
        derived["progress"] = max(record.progress, min(1.0, float(changes["progress"])))
    if changes.get("phase", record.phase) != record.phase:
        derived["phase_since"] = now
    if "status" in changes:
        if status == "running":
            derived |= {"started": now, "heartbeat": now}
        else:
            derived["finished"] = now
        if status == "successful":
            derived["progress"] = 1.0
    changed = replace(record, version=record.version + 1, updated=now, **(changes | derived))
    return finished_job(changed) if changed.status in FINISHED else changed


def finished_job(record: JobRecord) -> JobRecord:
    """The job without what only its run needs of the request; the journal has all of it.

    What is left is bounded: some two kilobytes, and what its webhooks take.
    """
    kept = {name: value for name, value in record.request.items() if name in _KEPT_OF_REQUEST}
    return replace(record, request=kept)


def with_heartbeat(record: JobRecord, attempt: int, now: float) -> JobRecord:
    """The running job with a fresh heartbeat. Raises StaleAttemptError."""
    _require_attempt(record, attempt)
    if record.status != "running":
        raise StaleAttemptError(f"a job that is {record.status} has no heartbeat")
    return replace(record, version=record.version + 1, heartbeat=now)


def cancelled_job(record: JobRecord, now: float) -> JobRecord:
    """The job after a request to cancel it: waiting ones end at once, finished ones stay as they are."""
    if record.status not in ACTIVE or record.cancel_requested:
        return record
    asked = replace(record, version=record.version + 1, updated=now, cancel_requested=True)
    if record.status != "accepted":
        return asked
    return finished_job(replace(asked, status="dismissed", finished=now))


def _next_attempt(record: JobRecord, now: float, requeues: int) -> JobRecord:
    return JobRecord(
        id=record.id,
        kind=record.kind,
        status="accepted",
        request=record.request,
        inputs=record.inputs,
        created=record.created,
        updated=now,
        version=record.version + 1,
        attempt=record.attempt + 1,
        requeues=requeues,
        more_webhooks=record.more_webhooks,
    )


def requeued_job(record: JobRecord, attempt: int, now: float, lost: bool) -> JobRecord:
    """The running job handed out again. Raises StaleAttemptError."""
    _require_attempt(record, attempt)
    if record.status != "running":
        raise StaleAttemptError(f"a job that is {record.status} is not requeued")
    return _next_attempt(record, now, record.requeues + (1 if lost else 0))


def restarted_job(record: JobRecord, new: JobRecord, now: float) -> JobRecord | None:
    """A failed or dismissed job, requested again by ``new``, as its next attempt; None for any other job.

    Both requests have the same result; the record holds the later one. Raises QuotaError as ``joined_job`` does.
    """
    if record.status not in ("failed", "dismissed"):
        return None
    earlier = [url for url in record.webhooks if url not in new.webhooks]
    asked = _with_webhooks(replace(record, request=new.request, inputs=new.inputs), earlier)
    return _next_attempt(asked, now, 0)


def joined_job(record: JobRecord, new: JobRecord) -> JobRecord:
    """A job that is not started again, after ``new`` has requested the same: it gets that webhook too.

    The job itself is returned when it has that webhook, or none was named. Its times stay: they are of its progress.
    Raises QuotaError (QUOTA_WEBHOOKS).
    """
    added = [url for url in new.webhooks if url not in record.webhooks]
    if not added:
        return record
    return replace(_with_webhooks(record, record.more_webhooks + added), version=record.version + 1)


def _with_webhooks(record: JobRecord, more: list[str]) -> JobRecord:
    changed = replace(record, more_webhooks=more)
    if len(changed.webhooks) > MAX_WEBHOOKS or sum(map(len, changed.webhooks)) > MAX_WEBHOOK_CHARACTERS:
        raise QuotaError("QUOTA_WEBHOOKS")
    return changed


def changed_field(record: FieldRecord, attempt: int | None, changes: dict[str, Any], now: float) -> FieldRecord:
    """The field after ``changes``. Raises StaleAttemptError when its import has ended or the attempt is older."""
    _refuse_unknown(changes, _CHANGEABLE_IN_FIELD)
    if attempt is not None:
        _require_attempt(record, attempt)
    if "state" in changes and record.state != "validating":
        raise StaleAttemptError(f"a field that is {record.state} cannot become {changes['state']}")
    views = {"views": "pending"} if changes.get("state") == "ready" else {}
    return replace(record, version=record.version + 1, updated=now, **(views | changes))


def restarted_field(record: FieldRecord, new: FieldRecord, now: float) -> FieldRecord | None:
    """A rejected field, uploaded again, as its next attempt; None for any other field."""
    if record.state != "rejected":
        return None
    again = replace(new, created=record.created, updated=now, version=record.version + 1, attempt=record.attempt + 1)
    return replace(again, library=record.library)


def reimported_field(
    record: FieldRecord, known: FieldRecord, description: dict[str, Any], label: str | None, now: float
) -> FieldRecord:
    """The field to be imported again. Raises StaleAttemptError when it is no longer as it was ``known``."""
    _require_attempt(record, known.attempt)
    if record.state == "validating" or record.description != known.description:
        raise StaleAttemptError("the field has changed")
    return FieldRecord(
        sha256=record.sha256,
        state="validating",
        bytes=record.bytes,
        created=record.created,
        updated=now,
        version=record.version + 1,
        label=label,
        description=description,
        attempt=record.attempt + 1,
        library=record.library,
    )


def restored_field(record: FieldRecord, before: FieldRecord, attempt: int, now: float) -> FieldRecord:
    """The field as it was ``before`` the attempt, whose number it keeps. Raises StaleAttemptError."""
    _require_attempt(record, attempt)
    if record.state != "validating":
        raise StaleAttemptError("its import has ended")
    return replace(before, version=record.version + 1, attempt=attempt, updated=now)


def retried_field(record: FieldRecord, attempt: int, now: float, lost: bool) -> FieldRecord:
    """The field with its import started again. Raises StaleAttemptError."""
    _require_attempt(record, attempt)
    if record.state != "validating":
        raise StaleAttemptError(f"a field that is {record.state} is not imported again")
    requeues = record.requeues + (1 if lost else 0)
    return replace(record, version=record.version + 1, updated=now, attempt=attempt + 1, requeues=requeues)


def fields_of(record: JobRecord) -> list[str]:
    """The fields that the job reads."""
    request = record.request
    several = (*(request.get("candidates") or ()), *(request.get("objects") or ()))
    named = (request.get("scene"), request.get("object"), *several)
    return [name for name in named if name]


def event_of(before: JobRecord | None, after: JobRecord) -> tuple[str, dict[str, object]] | None:
    """Name and data of the event that this change deserves, if it deserves one."""
    if before is not None and (before.status, before.attempt) == (after.status, after.attempt):
        if (before.phase, before.progress) == (after.phase, after.progress):
            return None
        name = "progress"
    else:
        name = "status"
    data: dict[str, object] = {
        "status": after.status,
        "phase": after.phase,
        "progress": after.progress,
        "attempt": after.attempt,
        "updated": after.updated,
    }
    if after.error is not None:
        data["error"] = after.error
    return name, data


def parse_event_id(text: str) -> tuple[int, int]:
    """(milliseconds, sequence) of an event id. Raises ValueError."""
    first, _, second = text.partition("-")
    parts = (first, second or "0")
    if not all(part.isascii() and part.isdigit() and len(part) <= 19 for part in parts):
        raise ValueError("not an event id")
    return int(parts[0]), int(parts[1])

"""The records that are the truth about fields and jobs, and the store that keeps them.

A job's state machine is monotonic: accepted -> running -> successful | failed | dismissed. Every change names the
attempt it belongs to; a writer of an older attempt loses (StaleAttemptError). RQ is transport, never truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
FieldState = Literal["validating", "ready", "rejected"]
ACTIVE: frozenset[str] = frozenset({"accepted", "running"})
FINISHED: frozenset[str] = frozenset({"successful", "failed", "dismissed"})


class RecordError(Exception):
    """Base of the store's refusals."""


class StaleAttemptError(RecordError):
    """The change came from an attempt that is no longer the current one, or from a state that forbids it."""


@dataclass(frozen=True)
class JobRecord:
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


@dataclass(frozen=True)
class FieldRecord:
    """One field, named by the SHA-256 of the bytes that were uploaded."""

    sha256: str
    state: FieldState
    bytes: int
    created: float
    updated: float
    version: int = 1
    label: str | None = None
    description: dict[str, Any] = field(default_factory=dict)
    """What the uploader said that the file does not: family, contraction, level mask ..."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the import found: family, bounds, parameters, plausibility, warnings."""
    error: dict[str, Any] | None = None


@dataclass(frozen=True)
class JobEvent:
    """One line of a job's event stream; ``id`` orders them and resumes a broken stream."""

    id: str
    name: str
    data: dict[str, Any]


class RecordStore(Protocol):
    """Where records live. Every method is blocking; the API calls them off the event loop or through short threads."""

    # jobs
    def create_job(self, record: JobRecord, max_active: int) -> tuple[JobRecord, bool]:
        """Store a new job, or return the one that exists under its id (False).

        A finished job that failed or was dismissed is started anew as the next attempt (True). Atomic.
        Raises QueueFullError when ``max_active`` jobs are active already.
        """
        ...

    def get_job(self, job_id: str) -> JobRecord | None: ...

    def list_jobs(self, status: str | None, limit: int, before: tuple[float, str] | None) -> list[JobRecord]:
        """Newest first, older than ``before`` = (created, id)."""
        ...

    def update_job(self, job_id: str, attempt: int, **changes: Any) -> JobRecord:
        """Compare-and-set: applies ``changes`` if ``attempt`` is current and the state machine allows it.

        Raises StaleAttemptError. Publishes an event whenever status, phase or progress changes.
        """
        ...

    def request_cancel(self, job_id: str) -> JobRecord | None:
        """Set cancel_requested; an accepted job is dismissed at once, a running one when its worker notices."""
        ...

    def delete_job(self, job_id: str) -> bool: ...

    def queue_position(self, job_id: str) -> int | None: ...

    def events(self, job_id: str, after: str | None, wait_s: float) -> list[JobEvent]:
        """Events after the given id (None: from the start), waiting at most ``wait_s`` for the first."""
        ...

    # fields
    def create_field(self, record: FieldRecord) -> tuple[FieldRecord, bool]: ...

    def get_field(self, sha256: str) -> FieldRecord | None: ...

    def list_fields(self, label: str | None, limit: int, before: tuple[float, str] | None) -> list[FieldRecord]: ...

    def update_field(self, sha256: str, **changes: Any) -> FieldRecord: ...

    def delete_field(self, sha256: str) -> bool: ...

    def jobs_using_field(self, sha256: str) -> Iterator[str]:
        """Ids of active jobs that need this field."""
        ...

    def ping(self) -> bool: ...


class QueueFullError(RecordError):
    """As many jobs are active as the service takes."""

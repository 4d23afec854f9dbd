"""The records that are the truth about fields and jobs, and the store that keeps them.

A job's state machine is monotonic: accepted -> running -> successful | failed | dismissed. Every change names the
attempt it belongs to; a writer of an older attempt loses (StaleAttemptError). RQ is transport, never truth.
Times are the store's own: one clock for every machine that shares it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

from regnf_state.ownership import ANONYMOUS, owner_of
from regnf_state.pages import Page, Position

JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
FieldState = Literal["validating", "ready", "rejected"]
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

    reason = "RECORDS_FULL"


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
    requeues: int = 0
    """How often this request was handed out again because its worker vanished, since it was last asked for."""
    worker: str | None = None
    """Who claimed the attempt."""
    phase_since: float | None = None
    verdict: str | None = None
    """Of a successful job: what its result says."""
    more_webhooks: list[str] = field(default_factory=list)
    """Addresses named by later requests for this job, which are told of its end as well."""
    unknown_members: dict[str, Any] = field(default_factory=dict)
    """What another release has written and this one does not know: it is written back as it is."""

    @property
    def webhooks(self) -> list[str]:
        """Every address that is told of the job's end, in the order of asking."""
        own = [self.request["webhook"]["url"]] if "webhook" in self.request else []
        return own + self.more_webhooks

    @property
    def owner(self) -> str:
        """The caller whose job it is: the owner of the scene."""
        return owner_of(self.request["scene"]) if "scene" in self.request else ANONYMOUS


@dataclass(frozen=True)
class FieldRecord:
    """One field. ``sha256`` is its reference: the SHA-256 of the bytes that were uploaded, and its owner's name."""

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
    attempt: int = 1
    """Grows each time the import starts anew; fences off the writer of an older one."""
    requeues: int = 0
    """How often this upload was handed out again because its worker vanished."""
    symmetry: dict[str, Any] | None = None
    """The turns that carry the object onto itself, once a job has used the field as an object: see the contract."""
    unknown_members: dict[str, Any] = field(default_factory=dict)
    """As in JobRecord."""

    @property
    def owner(self) -> str:
        """The caller whose field it is."""
        return owner_of(self.sha256)

    @property
    def kept_bytes(self) -> int:
        """What counts towards the quota: of a ready field, its upload or what the import made of it, if that is larger.

        A compressed upload may become a field a thousand times as large.
        """
        made = self.report.get("field_bytes") if self.state == "ready" else None
        return max(self.bytes, made) if isinstance(made, int) else self.bytes


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


class RecordStore(Protocol):
    """Where records live. Every method is blocking; the API calls them off the event loop or through short threads."""

    def now(self) -> float:
        """The store's clock, seconds since the epoch."""
        ...

    def set_if_absent(self, key: str, value: str, ttl_s: int, owner: str = ANONYMOUS) -> str:
        """Bind ``value`` to ``key`` for ``ttl_s`` seconds unless it is bound already; returns what is bound. Atomic.

        It counts as one of the owner's, who has ten thousand at most: beyond that the oldest is forgotten.
        """
        ...

    # jobs
    def create_job(self, record: JobRecord, max_active: int, quota: Quota = NO_QUOTA) -> tuple[JobRecord, bool]:
        """Store a new job, or return the one that exists under its id (False).

        A finished job that failed or was dismissed is started anew as the next attempt (True): enqueue what is
        returned, with its attempt. A webhook of ``record`` that the job does not have yet is added to it, and told at
        once if the job has finished. Atomic. Raises QueueFullError when ``max_active`` jobs are active already,
        QuotaError when the owner, or the job of webhooks, has as many as it may.
        """
        ...

    def get_job(self, job_id: str) -> JobRecord | None: ...

    def job_expired(self, job_id: str, owner: str = ANONYMOUS) -> bool:
        """Whether a job of this id and owner was kept once and has outlived its retention."""
        ...

    def list_jobs(
        self, status: str | None, limit: int, before: Position | None, owner: str | None = None
    ) -> Page[JobRecord]:
        """Newest first, older than ``before`` = (created, id); ``owner`` None: everybody's."""
        ...

    def update_job(self, job_id: str, attempt: int, **changes: Any) -> JobRecord:
        """Compare-and-set: applies ``changes`` if ``attempt`` is current and the state machine allows it.

        A change of status must be a move: the second attempt to set ``running`` fails, so it serves as a claim.
        Raises StaleAttemptError. Publishes an event whenever status, phase or progress changes.
        """
        ...

    def heartbeat(self, job_id: str, attempt: int) -> JobRecord:
        """Say that the running attempt lives; the record returned tells whether to stop. Raises StaleAttemptError."""
        ...

    def requeue_job(self, job_id: str, attempt: int, *, lost: bool = True) -> JobRecord:
        """A running job back to accepted as its next attempt, fencing the old one off. Raises StaleAttemptError.

        ``lost``: its worker vanished, which counts in ``requeues``; otherwise the worker gave it back in good order.
        """
        ...

    def request_cancel(self, job_id: str) -> JobRecord | None:
        """Set cancel_requested; an accepted job is dismissed at once, a running one when its worker notices."""
        ...

    def delete_job(self, job_id: str) -> bool:
        """Forget a finished job wholly; False when there is none. Raises StaleAttemptError while it is active."""
        ...

    def active_jobs(self) -> list[JobRecord]:
        """Every accepted or running job."""
        ...

    def expire_jobs(self) -> list[str]:
        """Delete what is left of finished jobs after their retention; their ids, so that their files go too."""
        ...

    def queue_position(self, job_id: str) -> int | None:
        """1 for the accepted job that is next; None for a job that does not wait."""
        ...

    def events(self, job_id: str, after: str | None) -> list[JobEvent]:
        """Events after the given id (None: from the start). Raises ValueError when ``after`` is no event id."""
        ...

    def news(self, positions: Sequence[tuple[str, str | None]]) -> list[JobNews]:
        """For each (job id, event id): the job, and its events after that one. One round trip for all of them."""
        ...

    # fields
    def create_field(self, record: FieldRecord, quota: Quota = NO_QUOTA) -> tuple[FieldRecord, bool]:
        """Store a new field, or return the one that exists (False).

        A rejected field starts anew with what ``record`` says, as the next attempt (True): enqueue its import.
        Rejected ones count towards no quota. Raises QuotaError.
        """
        ...

    def stored(self, owner: str) -> tuple[int, int]:
        """How many fields that were not rejected an owner has, and the bytes that are kept of them.

        Of a ready field these are the bytes of its upload or of what the import made, whichever are more.
        """
        ...

    def importing(self, owner: str) -> int:
        """How many of an owner's imports wait or run."""
        ...

    def remember_rejection(self, field: FieldRecord, error: dict[str, Any]) -> None:
        """Keep why this upload was rejected, also beyond the field's deletion."""
        ...

    def known_rejection(self, field: FieldRecord) -> dict[str, Any] | None:
        """Why the same upload of the same owner was rejected lately: bytes, description and gate are the same."""
        ...

    def get_field(self, sha256: str) -> FieldRecord | None: ...

    def get_fields(self, references: Sequence[str]) -> list[FieldRecord | None]:
        """Several fields in one round trip, in the order asked for."""
        ...

    def list_fields(
        self, label: str | None, limit: int, before: Position | None, owner: str | None = None
    ) -> Page[FieldRecord]:
        """Newest first, older than ``before`` = (created, reference); ``owner`` None: everybody's."""
        ...

    def update_field(self, sha256: str, *, attempt: int | None = None, **changes: Any) -> FieldRecord:
        """Compare-and-set. Raises StaleAttemptError for a field that is gone, or past ``attempt`` (None: any).

        ready and rejected are final within an attempt.
        """
        ...

    def delete_field(self, sha256: str) -> bool: ...

    def validating_fields(self) -> list[FieldRecord]:
        """Every field whose import has not ended."""
        ...

    def retry_import(self, sha256: str, attempt: int, *, lost: bool = True) -> FieldRecord:
        """Start an import anew as the next attempt; ``lost`` as in requeue_job. Raises StaleAttemptError."""
        ...

    def jobs_using_field(self, sha256: str) -> Iterator[str]:
        """Ids of active jobs that need this field."""
        ...

    def probe(self) -> None:
        """Returns when the store takes a write."""
        ...

"""The store that keeps the records of fields and jobs: what every kind of store can do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from regnf_core.library_entries import EntryNotes
from regnf_state.ownership import ANONYMOUS
from regnf_state.records import (
    NO_QUOTA,
    FieldRecord,
    JobEvent,
    JobNews,
    JobRecord,
    Quota,
    RecordError,
    UnreadableRecordError,
)

# The entries of callers' libraries: each is a part of the record of the field that it names.


class NameTakenError(RecordError):
    """Another entry of the caller's library has the name."""

    reason = "LIBRARY_NAME_TAKEN"


@dataclass(frozen=True)
class LibraryEntry:
    """What a library says of a field, and since when; ``field`` as it is now."""

    field: FieldRecord
    notes: EntryNotes
    added: float

    @classmethod
    def of(cls, field: FieldRecord) -> LibraryEntry | None:
        """The entry of a field; None where it has none."""
        said = field.library
        return None if said is None else cls(field, EntryNotes.from_dict(said), float(said["added"]))

    @property
    def symmetry(self) -> dict[str, Any] | None:
        """The one that holds: what people say goes before what was detected."""
        return self.notes.symmetry or self.field.symmetry


def recorded(notes: EntryNotes, added: float) -> dict[str, Any]:
    """An entry as the field's record keeps it."""
    return notes.to_dict() | {"added": added}


# Pages of a list of records, newest first.

_Record = TypeVar("_Record")
Position = tuple[float, str]
"""(created, name) of a record in a list."""

LOOKED_AT = 200
"""The most records that one page is chosen from: a filter that finds nothing takes a hundredth of a second a page."""
PAGE_BYTES = 512 * 1024
"""The most bytes of records that one page is chosen from, unless its first record alone has more. An answer has hardly
more than the records that it shows."""


@dataclass(frozen=True)
class Page(Generic[_Record]):
    """Records of a list, and the position after which the next page begins; None when this is the last.

    A page may hold fewer records than were asked for, or none, and not be the last.
    """

    records: list[_Record]
    rest: Position | None


def all_of(page_after: Callable[[Position | None], Page[_Record]]) -> Iterator[_Record]:
    """All records of a list, page by page."""
    rest: Position | None = None
    while True:
        page = page_after(rest)
        yield from page.records
        rest = page.rest
        if rest is None:
            return


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

    def create_jobs(
        self, records: Sequence[JobRecord], max_active: int, quota: Quota = NO_QUOTA
    ) -> list[tuple[JobRecord, bool] | RecordError]:
        """The same for several, in a few round trips: a refusal takes the place of a job that is refused."""
        ...

    def get_job(self, job_id: str) -> JobRecord | None: ...

    def get_jobs(self, job_ids: Sequence[str]) -> list[JobRecord | UnreadableRecordError | None]:
        """Several jobs in one round trip, in the order asked for; one that cannot be read keeps no other back."""
        ...

    def active_among(self, job_ids: Sequence[str]) -> set[str]:
        """Which of these jobs wait or run, without reading their records. Redis may have lost some."""
        ...

    def room_for_jobs(self, owner: str, max_active: int, quota: Quota) -> tuple[int, str]:
        """How many jobs ``create_job`` takes of the owner now, and the reason that one more is refused for."""
        ...

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
        """How many fields an owner has of which bytes are kept, and these bytes: few of the rejected ones.

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

    def reimport_field(self, known: FieldRecord, description: dict[str, Any], label: str | None) -> FieldRecord:
        """A field whose import has ended, to be imported anew as the next attempt, with another description.

        Raises StaleAttemptError when it has changed since it was ``known``.
        """
        ...

    def undo_reimport(self, before: FieldRecord, attempt: int) -> FieldRecord:
        """The field as it was ``before`` that attempt, which has not begun. Raises StaleAttemptError."""
        ...

    def fields_with_original(self, owner: str) -> list[FieldRecord]:
        """An owner's fields whose uploads are kept after their import, those whose time is over first, first."""
        ...

    def delete_field(self, sha256: str) -> bool: ...

    # libraries: an entry is a part of the record of its field
    def set_entry(self, known: FieldRecord, notes: EntryNotes | None) -> FieldRecord:
        """Make the field an entry of its owner's library, change the entry, or (None) take it out.

        Raises NameTakenError, and StaleAttemptError when the entry is no longer as it was ``known``.
        """
        ...

    def entries_named(self, owner: str, names: Sequence[str]) -> list[LibraryEntry | None]:
        """An owner's entries by their names, in the order asked for."""
        ...

    def list_entries(
        self, owner: str, tag: str | None, part: str | None, limit: int, before: Position | None
    ) -> Page[FieldRecord]:
        """An owner's entries, the one added last first: those with the tag, and with ``part`` in their names."""
        ...

    def validating_fields(self) -> list[FieldRecord]:
        """Every field whose import has not ended."""
        ...

    def undrawn_fields(self) -> list[str]:
        """The ready fields whose mesh and picture are to be made, those asked for last first."""
        ...

    def draw_next(self, sha256: str) -> None:
        """Note that somebody wants to see a field whose mesh and picture are to be made."""
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

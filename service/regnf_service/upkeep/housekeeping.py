"""Deletes what is no longer needed: unused fields, results beyond the storage cap, and files that crashes left behind.

Nothing here is urgent, so the leader does it once an hour. What a live job needs is never deleted: the record of a
field is deleted first, and restored if a job has requested the field in between; only then the bytes are deleted.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from redis import Redis
from redis.exceptions import LockError
from redis.lock import Lock

from regnf_state.batches import Batches
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.pieces import Pieces
from regnf_state.record_store import all_of
from regnf_state.records import ACTIVE, FieldRecord, JobRecord, UnreadableRecordError
from regnf_state.redis.unreadable import PREFIX
from regnf_state.room import Room
from regnf_state.settings import Settings
from regnf_state.transitions import fields_of

# Leadership among processes that share a Redis: one at a time, for as long as it keeps confirming.


class LeaseLostError(Exception):
    """Another process leads, or may lead: stop."""


class Term:
    """One term of leadership. Terms are numbered, and a later leader has a larger number."""

    def __init__(self, lock: Lock, number: int) -> None:
        self._lock = lock
        self.number = number

    def confirm(self) -> None:
        """Call this before anything that cannot be undone: the term begins again. Raises LeaseLostError."""
        try:
            self._lock.reacquire()
        except LockError as error:
            raise LeaseLostError(f"term {self.number} is over") from error


class Lease:
    """A lease named ``key`` that expires ``seconds`` after it was last confirmed."""

    def __init__(self, redis: Redis, key: str, seconds: float) -> None:
        self._redis = redis
        self._key = key
        self._seconds = seconds

    @contextmanager
    def held(self) -> Iterator[Term | None]:
        """A term, if no other process has one; it ends with the block."""
        lock = self._redis.lock(self._key, timeout=self._seconds, blocking=False, thread_local=False)
        if not lock.acquire():
            yield None
            return
        try:
            yield Term(lock, int(self._redis.incr(f"{self._key}:terms")))
        finally:
            with suppress(LockError):
                lock.release()


_DONE_KEY = f"{PREFIX}housekeeping"
_EVERY_S = 3600
_ORPHANED_AFTER_S = 24 * 3600.0
_UNTOUCHED_FOR_S = 3600.0
"""Nothing younger is deleted for the cap: its owner may want to use it now."""
_PAGE = 200
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Kept:
    """How many bytes a job's or a field's folder holds, and when the newest of them was written."""

    bytes: int = 0
    modified: float = 0.0


Removed = dict[str, list[str]]
"""What one round took away: ids of `fields` and `jobs`, and folders that belonged to no record, `orphans`."""


class Housekeeper:
    """Tidies the blob store of one service."""

    def __init__(self, records: JournaledRecordStore, blobs: BlobStore, redis: Redis, settings: Settings) -> None:
        self._records = records
        self._blobs = blobs
        self._redis = redis
        self._keep_unused_s = settings.field_retention_s
        self._retention_s = settings.job_retention_s
        self._cap = settings.max_stored_bytes
        self._room = Room(records, blobs, redis, settings)
        self._pieces = Pieces(blobs, settings)
        self._batches = Batches(blobs)

    def run_if_due(self, term: Term) -> Removed:
        """A round, if the last one is an hour ago."""
        if not self._redis.set(_DONE_KEY, term.number, nx=True, ex=_EVERY_S):
            return {}
        return self.run(term)

    def tidy_records(self, term: Term) -> int:
        """Finished jobs beyond the bounds go: how many. Every round. Raises LeaseLostError, RedisError, OSError."""
        return self._room.tidy(term.confirm)

    def run(self, term: Term) -> Removed:
        """One round. Raises LeaseLostError, RedisError, OSError."""
        if not self._records.generation.is_current():
            return {}  # records that Redis has lost must not look unused
        now = self._records.now()
        self._blobs.sweep(_ORPHANED_AFTER_S)
        self._pieces.expire(now)
        self._batches.expire(now - self._retention_s, term.confirm)
        folders = self._folders()
        self._forget_expired(term)
        removed = {"orphans": list(self._drop_orphans(term, folders)), "fields": list[str](), "jobs": list[str]()}
        for used, field in self._unused_fields():
            if self._is_old(used, field, now) and self._drop_field(term, field):
                removed["fields"].append(field.sha256)
        if self._cap is not None:
            self._drop_beyond_cap(term, self._cap, now, removed)
        return {kind: names for kind, names in removed.items() if names}

    def _is_old(self, used: float, field: FieldRecord, now: float) -> bool:
        if field.state == "rejected":
            return field.updated + self._retention_s <= now
        return self._keep_unused_s is not None and used + self._keep_unused_s <= now

    def _folders(self) -> dict[str, Kept]:
        found: dict[str, Kept] = defaultdict(Kept)
        for top in ("jobs", "fields"):
            for entry in self._blobs.entries(top):
                folder = "/".join(entry.key.split("/")[:2])
                kept = found[folder]
                found[folder] = Kept(kept.bytes + entry.bytes, max(kept.modified, entry.modified))
        return found

    def _sizes(self) -> Counter[str]:
        """The bytes of everything that is stored: of jobs and fields with their journals, batches, pieces of uploads,
        and the rest."""
        sizes: Counter[str] = Counter()
        for entry in self._blobs.entries(""):
            top, *rest = entry.key.split("/")
            path = rest if top == "journal" else [top, *rest]
            sizes["/".join(path[:2] if path[0] in ("jobs", "fields") else path[:3])] += entry.bytes
        return sizes

    def _forget_expired(self, term: Term) -> None:
        """Delete journal entries of jobs whose records expired while a process died."""
        for job_id in self._records.journal.jobs():
            if self._is_known("jobs", job_id):
                continue
            now = self._records.now()
            job = self._records.journal.recall(job_id, now)
            if job is not None and self._records.has_expired(job, now):
                term.confirm()
                self._blobs.delete_prefix(f"jobs/{job_id}")
                self._records.journal.forget(job_id)

    def _is_known(self, top: str, name: str) -> bool:
        """Whether there is a record, be it one that cannot be read: its files stay until the operator has looked."""
        try:
            known = self._records.get_job(name) if top == "jobs" else self._records.get_field(name)
        except UnreadableRecordError:
            return True
        return known is not None

    def _drop_orphans(self, term: Term, folders: dict[str, Kept]) -> Iterator[str]:
        """Folders that were written a day ago at least and belong to no record."""
        now = self._records.now()
        for folder, kept in list(folders.items()):
            top, name = folder.split("/")
            if not self._is_known(top, name) and kept.modified + _ORPHANED_AFTER_S <= now:
                term.confirm()
                self._blobs.delete_prefix(folder)
                del folders[folder]
                yield folder

    def _unused_fields(self) -> list[tuple[float, FieldRecord]]:
        """Fields that no active job needs and no library names, least recently used first, with the time of the use."""
        needed = {name for job in self._records.active_jobs() for name in fields_of(job)}
        idle = [field for field in self._fields() if field.state != "validating" and field.sha256 not in needed]
        idle = [field for field in idle if field.library is None or field.state == "rejected"]
        uses = self._records.last_uses([field.sha256 for field in idle])
        return sorted(zip(uses, idle, strict=True), key=lambda one: (one[0], one[1].sha256))

    def _fields(self) -> Iterator[FieldRecord]:
        return all_of(lambda before: self._records.list_fields(None, _PAGE, before))

    def _finished_jobs(self) -> Iterator[JobRecord]:
        jobs = all_of(lambda before: self._records.list_jobs(None, _PAGE, before))
        return (job for job in jobs if job.status not in ACTIVE)

    def _drop_field(self, term: Term, field: FieldRecord) -> bool:
        """Delete a field unless a job has requested it in between."""
        term.confirm()
        self._records.delete_field(field.sha256)
        if next(iter(self._records.jobs_using_field(field.sha256)), None) is not None:
            self._records.restore_field(field)
            self._records.journal.keep_field(field)
            return False
        self._blobs.delete_prefix(f"fields/{field.sha256}")
        logger.info("field %s is deleted: it was not used for a long time", field.sha256)
        return True

    def _drop_beyond_cap(self, term: Term, cap: int, now: float, removed: Removed) -> None:
        """Finished jobs, unused fields, batches and unfinished uploads, oldest first, until the rest is within the
        cap."""
        sizes = self._sizes()
        total = sizes.total()
        if total <= cap:
            return
        candidates: list[tuple[float, str, Any]] = [
            *((job.finished or 0.0, f"jobs/{job.id}", job) for job in self._finished_jobs()),
            *((used, f"fields/{field.sha256}", field) for used, field in self._unused_fields()),
            *((entry.modified, entry.key, None) for entry in self._batches.entries()),
            *((one.modified, one.folder, None) for one in self._pieces.unfinished()),
        ]
        for touched, folder, record in sorted(candidates, key=lambda one: one[:2]):
            if total <= cap or touched + _UNTOUCHED_FOR_S > now:
                break
            if isinstance(record, FieldRecord):
                if not self._drop_field(term, record):
                    continue
                removed["fields"].append(record.sha256)
            else:
                term.confirm()
                if record is not None:
                    self._records.delete_job(record.id)
                    removed["jobs"].append(record.id)
                if folder.startswith("batches/"):  # one blob; its jobs stay
                    self._blobs.delete(folder)
                else:
                    self._blobs.delete_prefix(folder)
            total -= sizes[folder]

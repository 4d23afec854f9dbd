"""Records in memory."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from regnf_state import transitions
from regnf_state.ownership import ANONYMOUS
from regnf_state.records import (
    ACTIVE,
    NO_QUOTA,
    FieldRecord,
    JobEvent,
    JobNews,
    JobRecord,
    QueueFullError,
    Quota,
    QuotaError,
    StaleAttemptError,
)

_Record = TypeVar("_Record", JobRecord, FieldRecord)


def _page(records: list[_Record], name: str, limit: int, before: tuple[float, str] | None) -> list[_Record]:
    def order(record: _Record) -> tuple[float, str]:
        return record.created, getattr(record, name)

    older = [record for record in records if before is None or order(record) < before]
    return sorted(older, key=order, reverse=True)[:limit]


class InMemoryRecordStore:
    """A RecordStore in one process. ``clock`` may be replaced to move time by hand."""

    def __init__(self, retention_s: float = 7 * 24 * 3600, clock: Callable[[], float] = time.time) -> None:
        self._retention_s = retention_s
        self._clock = clock
        self._changed = threading.Condition(threading.RLock())
        self._jobs: dict[str, JobRecord] = {}
        self._waiting: list[str] = []
        self._events: dict[str, list[JobEvent]] = {}
        self._tombstones: dict[str, str] = {}
        self._fields: dict[str, FieldRecord] = {}
        self._attempts_at_deleted: dict[str, int] = {}
        self._remembered: dict[str, tuple[str, float]] = {}

    def now(self) -> float:
        return self._clock()

    def ping(self) -> bool:
        return True

    def set_if_absent(self, key: str, value: str, ttl_s: int) -> str:
        with self._changed:
            known = self._remembered.get(key)
            if known is None or known[1] <= self.now():
                known = self._remembered[key] = (value, self.now() + ttl_s)
            return known[0]

    # jobs

    def _live(self, job_id: str) -> JobRecord | None:
        record = self._jobs.get(job_id)
        if record is not None and record.finished is not None and record.finished + self._retention_s <= self.now():
            return None
        return record

    def _require_job(self, job_id: str) -> JobRecord:
        record = self._live(job_id)
        if record is None:
            raise StaleAttemptError("there is no such job")
        return record

    def _save(self, record: JobRecord) -> JobRecord:
        before = self._jobs.get(record.id)
        self._jobs[record.id] = record
        if record.status != "accepted":
            self._waiting = [job_id for job_id in self._waiting if job_id != record.id]
        elif record.id not in self._waiting:
            self._waiting.append(record.id)
        event = transitions.event_of(before, record)
        if event is not None:
            stream = self._events.setdefault(record.id, [])
            last = transitions.parse_event_id(stream[-1].id)[0] if stream else 0
            stream.append(JobEvent(f"{last + 1}-0", event[0], dict(event[1])))
        self._changed.notify_all()
        return record

    def create_job(self, record: JobRecord, max_active: int, quota: Quota = NO_QUOTA) -> tuple[JobRecord, bool]:
        with self._changed:
            known = self._live(record.id)
            fresh = record if known is None else transitions.restarted_job(known, self.now())
            if fresh is None:
                assert known is not None
                return known, False
            if len(self.active_jobs()) >= max_active:
                raise QueueFullError(f"{max_active} jobs are active already")
            owned = sum(active.owner == record.owner for active in self.active_jobs())
            if quota.active_jobs is not None and owned >= quota.active_jobs:
                raise QuotaError("QUOTA_ACTIVE_JOBS")
            self._tombstones.pop(record.id, None)
            return self._save(fresh), True

    def get_job(self, job_id: str) -> JobRecord | None:
        with self._changed:
            return self._live(job_id)

    def job_expired(self, job_id: str, owner: str = ANONYMOUS) -> bool:
        with self._changed:
            dead = self._jobs[job_id].owner if job_id in self._jobs and self._live(job_id) is None else None
            return owner in (dead, self._tombstones.get(job_id))

    def list_jobs(
        self, status: str | None, limit: int, before: tuple[float, str] | None, owner: str | None = None
    ) -> list[JobRecord]:
        with self._changed:
            live = [record for job_id in self._jobs if (record := self._live(job_id)) is not None]
            live = [record for record in live if owner in (None, record.owner)]
            return _page([record for record in live if status in (None, record.status)], "id", limit, before)

    def update_job(self, job_id: str, attempt: int, **changes: Any) -> JobRecord:
        with self._changed:
            return self._save(transitions.changed_job(self._require_job(job_id), attempt, changes, self.now()))

    def heartbeat(self, job_id: str, attempt: int) -> JobRecord:
        with self._changed:
            return self._save(transitions.with_heartbeat(self._require_job(job_id), attempt, self.now()))

    def requeue_job(self, job_id: str, attempt: int, *, lost: bool = True) -> JobRecord:
        with self._changed:
            return self._save(transitions.requeued_job(self._require_job(job_id), attempt, self.now(), lost))

    def request_cancel(self, job_id: str) -> JobRecord | None:
        with self._changed:
            record = self._live(job_id)
            return None if record is None else self._save(transitions.cancelled_job(record, self.now()))

    def delete_job(self, job_id: str) -> bool:
        with self._changed:
            record = self._live(job_id)
            if record is not None and record.status in ACTIVE:
                raise StaleAttemptError(f"a job that is {record.status} is not deleted")
            self._jobs.pop(job_id, None)
            self._events.pop(job_id, None)
            self._tombstones.pop(job_id, None)
            return record is not None

    def active_jobs(self) -> list[JobRecord]:
        with self._changed:
            return [record for record in self._jobs.values() if record.status in ACTIVE]

    def expire_jobs(self) -> list[str]:
        with self._changed:
            expired = [job_id for job_id in self._jobs if self._live(job_id) is None]
            for job_id in expired:
                self._tombstones[job_id] = self._jobs.pop(job_id).owner
                self._events.pop(job_id, None)
            return expired

    def queue_position(self, job_id: str) -> int | None:
        with self._changed:
            return self._waiting.index(job_id) + 1 if job_id in self._waiting else None

    def events(self, job_id: str, after: str | None) -> list[JobEvent]:
        bound = (0, 0) if after is None else transitions.parse_event_id(after)
        with self._changed:
            stream = self._events.get(job_id, [])
            return [event for event in stream if transitions.parse_event_id(event.id) > bound]

    def news(self, positions: Sequence[tuple[str, str | None]]) -> list[JobNews]:
        with self._changed:
            return [JobNews(self._live(job_id), self.events(job_id, after)) for job_id, after in positions]

    # fields

    def _require_field(self, sha256: str) -> FieldRecord:
        record = self._fields.get(sha256)
        if record is None:
            raise StaleAttemptError("there is no such field")
        return record

    def _save_field(self, record: FieldRecord) -> FieldRecord:
        self._fields[record.sha256] = record
        return record

    def create_field(self, record: FieldRecord, quota: Quota = NO_QUOTA) -> tuple[FieldRecord, bool]:
        with self._changed:
            known = self._fields.get(record.sha256)
            before = self._attempts_at_deleted.get(record.sha256, 0)
            first = replace(record, attempt=record.attempt + before)
            fresh = first if known is None else transitions.restarted_field(known, record, self.now())
            if fresh is None:
                assert known is not None
                return known, False
            count, size = self.stored(fresh.owner)
            if quota.fields is not None and count >= quota.fields:
                raise QuotaError("QUOTA_FIELDS")
            if quota.stored_bytes is not None and size + fresh.bytes > quota.stored_bytes:
                raise QuotaError("QUOTA_STORED_BYTES")
            return self._save_field(fresh), True

    def stored(self, owner: str) -> tuple[int, int]:
        with self._changed:
            sizes = [one.bytes for one in self._fields.values() if one.owner == owner and one.state != "rejected"]
            return len(sizes), sum(sizes)

    def get_field(self, sha256: str) -> FieldRecord | None:
        with self._changed:
            return self._fields.get(sha256)

    def get_fields(self, references: Sequence[str]) -> list[FieldRecord | None]:
        with self._changed:
            return [self._fields.get(name) for name in references]

    def list_fields(
        self, label: str | None, limit: int, before: tuple[float, str] | None, owner: str | None = None
    ) -> list[FieldRecord]:
        with self._changed:
            chosen = [record for record in self._fields.values() if label in (None, record.label)]
            chosen = [record for record in chosen if owner in (None, record.owner)]
            return _page(chosen, "sha256", limit, before)

    def update_field(self, sha256: str, *, attempt: int | None = None, **changes: Any) -> FieldRecord:
        with self._changed:
            known = self._require_field(sha256)
            return self._save_field(transitions.changed_field(known, attempt, changes, self.now()))

    def validating_fields(self) -> list[FieldRecord]:
        with self._changed:
            return [record for record in self._fields.values() if record.state == "validating"]

    def retry_import(self, sha256: str, attempt: int, *, lost: bool = True) -> FieldRecord:
        with self._changed:
            known = self._require_field(sha256)
            return self._save_field(transitions.retried_field(known, attempt, self.now(), lost))

    def delete_field(self, sha256: str) -> bool:
        with self._changed:
            known = self._fields.pop(sha256, None)
            if known is not None:
                self._attempts_at_deleted[sha256] = known.attempt
            return known is not None

    def jobs_using_field(self, sha256: str) -> Iterator[str]:
        return iter([record.id for record in self.active_jobs() if transitions.uses_field(record, sha256)])

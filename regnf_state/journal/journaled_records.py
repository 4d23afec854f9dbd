"""Records in Redis that can be rebuilt from the journal: an accepted job is journaled before the caller gets an answer.

The end of a job is journaled afterwards, if possible. If this entry and Redis are both lost, the job is run once more,
and finds the published result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

from redis import Redis

from regnf_core.library_entries import EntryNotes
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.generation import Generation
from regnf_state.journal.journal import Journal
from regnf_state.records import (
    FINISHED,
    NO_QUOTA,
    FieldRecord,
    JobNews,
    JobRecord,
    Quota,
    RecordError,
    UnreadableRecordError,
)
from regnf_state.redis.documents import Kind
from regnf_state.redis.jobs import JOB, RedisRecordStore
from regnf_state.redis.keys import PREFIX
from regnf_state.redis.unreadable import Stored
from regnf_state.transitions import fields_of

_USED = f"{PREFIX}fields:used"
logger = logging.getLogger(__name__)


class JournaledRecordStore(RedisRecordStore):
    """A RecordStore in Redis and in the journal of ``blobs``. Accepting raises OSError when that takes no bytes."""

    def __init__(self, redis: Redis, retention_s: int, blobs: BlobStore) -> None:
        super().__init__(redis, retention_s)
        self.journal = Journal(blobs)

    @cached_property
    def generation(self) -> Generation:
        """Tells whether Redis holds what the journal says."""
        return Generation(self._redis, self.journal)

    def _heal(self, kind: Kind[Any], name: str, stored: Stored, error: UnreadableRecordError) -> None:
        """Set a record aside, and put what the journal says in its place. Raises OSError: then nothing has changed."""
        now = self.now()
        job = self.journal.recall(name, now) if kind is JOB and not error.newer else None
        field = self.journal.recall_field(name) if kind is not JOB and not error.newer else None
        super()._heal(kind, name, stored, error)
        if job is not None and not self.has_expired(job, now):
            self.restore_job(job)
        if field is not None:
            self.restore_field(field)

    # jobs

    def create_jobs(
        self, records: Sequence[JobRecord], max_active: int, quota: Quota = NO_QUOTA
    ) -> list[tuple[JobRecord, bool] | RecordError]:
        if not self.generation.is_current():
            for record in records:
                if not self._redis.exists(JOB.key(record.id)):
                    self.recall_job(record.id)  # Redis has lost it: its attempts must not be counted from one again
        answers = super().create_jobs(records, max_active, quota)
        taken = [answer for answer in answers if not isinstance(answer, RecordError)]
        used = {name: job.updated for job, created in taken if created for name in fields_of(job)}
        if used:
            self._redis.zadd(_USED, used)
        # also those known before: their first writer may have died before these lines
        self.journal.accept([job for job, _ in taken if job.status == "accepted"])
        self.journal.join([job for job, created in taken if job.more_webhooks and not created])
        return answers

    def get_job(self, job_id: str) -> JobRecord | None:
        found = super().get_job(job_id)
        if found is None and not self.generation.is_current():
            self.recall_job(job_id)
            found = super().get_job(job_id)
        return found

    def get_jobs(self, job_ids: Sequence[str]) -> list[JobRecord | UnreadableRecordError | None]:
        found = super().get_jobs(job_ids)
        missing = [name for name, job in zip(job_ids, found, strict=True) if job is None]
        if not missing or self.generation.is_current():
            return found
        for name in missing:
            self.recall_job(name)
        return super().get_jobs(job_ids)

    def news(self, positions: Sequence[tuple[str, str | None]]) -> list[JobNews]:
        found = super().news(positions)
        if all(one.record is not None for one in found) or self.generation.is_current():
            return found
        for job_id, _ in positions:
            self.get_job(job_id)  # recalls the jobs that Redis has lost
        return super().news(positions)

    def recall_job(self, job_id: str) -> JobRecord | None:
        """Rebuild a lost record. The job as it continues; None when there was nothing to rebuild."""
        now = self.now()
        job = self.journal.recall(job_id, now)
        if job is None or self.has_expired(job, now):
            return None
        return job if self.restore_job(job) else None

    def has_expired(self, job: JobRecord, now: float) -> bool:
        """Whether the job has outlived its retention."""
        return job.finished is not None and job.finished + self._retention_s <= now

    def update_job(self, job_id: str, attempt: int, **changes: Any) -> JobRecord:
        if changes.get("status") == "running" and attempt > 1:
            self.journal.begin(job_id, attempt)
        job = super().update_job(job_id, attempt, **changes)
        if changes.get("status") in FINISHED:
            _if_possible(f"the end of job {job_id}", lambda: self.journal.end(job))
        return job

    def request_cancel(self, job_id: str) -> JobRecord | None:
        job = super().request_cancel(job_id)
        if job is not None and job.status == "dismissed":
            _if_possible(f"the end of job {job_id}", lambda: self.journal.end(job))
        return job

    def delete_job(self, job_id: str) -> bool:
        deleted = super().delete_job(job_id)
        self.journal.forget(job_id)
        return deleted

    def expire_jobs(self) -> list[str]:
        expired = super().expire_jobs()
        for job_id in expired:
            self.journal.forget(job_id)
        return expired

    # fields

    def create_field(self, record: FieldRecord, quota: Quota = NO_QUOTA) -> tuple[FieldRecord, bool]:
        field, created = super().create_field(record, quota)
        if created or field.state == "validating":
            self.journal.keep_field(field)
        return field, created

    def last_uses(self, references: Sequence[str]) -> list[float]:
        """When a job was last accepted that reads each field; now, from now on, where that is not known."""
        now = self.now()
        with self._redis.pipeline(transaction=False) as pipeline:
            for reference in references:
                pipeline.zadd(_USED, {reference: now}, nx=True)
                pipeline.zscore(_USED, reference)
            answers = pipeline.execute()
        return [float(score) for score in answers[1::2]]

    def get_field(self, sha256: str) -> FieldRecord | None:
        found = super().get_field(sha256)
        if found is None and not self.generation.is_current():
            self.recall_field(sha256)
            found = super().get_field(sha256)
        return found

    def get_fields(self, references: Sequence[str]) -> list[FieldRecord | None]:
        found = super().get_fields(references)
        missing = [name for name, field in zip(references, found, strict=True) if field is None]
        if not missing or self.generation.is_current():
            return found
        for name in missing:
            self.recall_field(name)
        return super().get_fields(references)

    def recall_field(self, sha256: str) -> FieldRecord | None:
        """Rebuild a lost record. The field as it continues; None when there was nothing to rebuild."""
        field = self.journal.recall_field(sha256)
        return field if field is not None and self.restore_field(field) else None

    def update_field(self, sha256: str, *, attempt: int | None = None, **changes: Any) -> FieldRecord:
        field = super().update_field(sha256, attempt=attempt, **changes)
        _if_possible(f"what became of field {sha256}", lambda: self.journal.keep_field(field))
        return field

    def retry_import(self, sha256: str, attempt: int, *, lost: bool = True) -> FieldRecord:
        field = super().retry_import(sha256, attempt, lost=lost)
        _if_possible(f"what became of field {sha256}", lambda: self.journal.keep_field(field))
        return field

    def reimport_field(self, known: FieldRecord, description: dict[str, Any], label: str | None) -> FieldRecord:
        field = super().reimport_field(known, description, label)
        self.journal.keep_field(field)
        return field

    def undo_reimport(self, before: FieldRecord, attempt: int) -> FieldRecord:
        field = super().undo_reimport(before, attempt)
        self.journal.keep_field(field)
        return field

    def set_entry(self, known: FieldRecord, notes: EntryNotes | None) -> FieldRecord:
        field = super().set_entry(known, notes)
        self.journal.keep_field(field)
        return field

    def delete_field(self, sha256: str) -> bool:
        deleted = super().delete_field(sha256)
        self._redis.zrem(_USED, sha256)
        self.journal.forget_field(sha256)
        return deleted


def _if_possible(what: str, write: Callable[[], None]) -> None:
    try:
        write()
    except OSError as error:
        logger.warning("%s is not in the journal: %s", what, error)

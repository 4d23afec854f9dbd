"""Records in Redis that can be rebuilt from the journal: an accepted job is journaled before the caller gets an answer.

The end of a job is journaled afterwards, if possible. If this entry and Redis are both lost, the job is run once more,
and finds the published result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from typing import Any, TypeVar
from uuid import uuid4

from redis import Redis

from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journal import GENERATION_KEY, Journal, claim_storage
from regnf_state.records import NO_QUOTA, FieldRecord, JobNews, JobRecord, Quota, RecordError, UnreadableRecordError
from regnf_state.redis.documents import Kind, text
from regnf_state.redis.jobs import JOB, RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.redis.unreadable import PREFIX, Stored
from regnf_state.transitions import fields_of

# Whether Redis holds what the journal says: it does not after it was emptied, exchanged, or restarted.
#
# A key in Redis names the blob store whose journal was read into it, and the run of the server: one that restarts may
# have lost the last second of its history.

_MARK = "if redis.call('GET', KEYS[1]) == ARGV[1] then redis.call('SET', KEYS[1], ARGV[2]) return 1 end return 0"


class Generation:
    """The mark of one blob store in one Redis."""

    def __init__(self, redis: Redis, journal: Journal) -> None:
        self._redis = redis
        self._journal = journal
        self._mark = redis.register_script(_MARK)

    @cached_property
    def _storage_id(self) -> str:
        return self._journal.storage_id()

    def _name(self) -> str:
        server: Any = self._redis.info("server")
        return f"{self._storage_id}:{server.get('run_id', '')}"

    def is_current(self) -> bool:
        """Whether everything in the journal is in Redis."""
        held: Any = self._redis.get(GENERATION_KEY)
        return held is not None and text(held) == self._name()

    def begin(self) -> str:
        """Note that the journal will be read now; returns the token for ``end``. Raises StorageMismatchError."""
        claim_storage(self._redis, self._storage_id)
        token = f"reading:{uuid4().hex}"
        self._redis.set(GENERATION_KEY, token)
        return token

    def end(self, token: str) -> bool:
        """Note that all of it is in Redis. False when Redis was emptied or another process began in between."""
        return bool(self._mark(keys=[GENERATION_KEY], args=[token, self._name()]))


_USED = f"{PREFIX}fields:used"
_Found = TypeVar("_Found")
Recall = Callable[[str], object]
logger = logging.getLogger(__name__)


class JournaledRecordStore(RecordStore):
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

    def _found(self, ask: Callable[[], _Found], missing: Callable[[_Found], list[str]], recall: Recall) -> _Found:
        """What ``ask`` finds, asked again once what is ``missing`` is rebuilt, if Redis has lost it."""
        found = ask()
        lost = missing(found)
        if not lost or self.generation.is_current():
            return found
        for name in lost:
            recall(name)
        return ask()

    def get_job(self, job_id: str) -> JobRecord | None:
        ask = partial(super().get_job, job_id)
        return self._found(ask, lambda job: [job_id] if job is None else [], self.recall_job)

    def get_jobs(self, job_ids: Sequence[str]) -> list[JobRecord | UnreadableRecordError | None]:
        ask = partial(super().get_jobs, job_ids)
        return self._found(ask, partial(_missing, job_ids), self.recall_job)

    def news(self, positions: Sequence[tuple[str, str | None]]) -> list[JobNews]:
        ids, ask = [job_id for job_id, _ in positions], partial(super().news, positions)
        return self._found(ask, lambda news: _missing(ids, [one.record for one in news]), self.recall_job)

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
        return super().update_job(job_id, attempt, **changes)

    def _note_end(self, job: JobRecord) -> None:
        _if_possible(f"the end of job {job.id}", lambda: self.journal.end(job))

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
        ask = partial(super().get_field, sha256)
        return self._found(ask, lambda field: [sha256] if field is None else [], self.recall_field)

    def get_fields(self, references: Sequence[str]) -> list[FieldRecord | None]:
        ask = partial(super().get_fields, references)
        return self._found(ask, partial(_missing, references), self.recall_field)

    def recall_field(self, sha256: str) -> FieldRecord | None:
        """Rebuild a lost record. The field as it continues; None when there was nothing to rebuild."""
        field = self.journal.recall_field(sha256)
        return field if field is not None and self.restore_field(field) else None

    def _note_field(self, field: FieldRecord, must_last: bool) -> None:
        if must_last:
            self.journal.keep_field(field)
        else:
            _if_possible(f"what became of field {field.sha256}", lambda: self.journal.keep_field(field))

    def delete_field(self, sha256: str) -> bool:
        deleted = super().delete_field(sha256)
        self._redis.zrem(_USED, sha256)
        self.journal.forget_field(sha256)
        return deleted


def _missing(names: Sequence[str], found: Sequence[object]) -> list[str]:
    return [name for name, record in zip(names, found, strict=True) if record is None]


def _if_possible(what: str, write: Callable[[], None]) -> None:
    try:
        write()
    except OSError as error:
        logger.warning("%s is not in the journal: %s", what, error)


# Rebuilding the records from the journal after Redis has lost them.

_AT_ONCE = 16
_PAGE = 1000
_Record = TypeVar("_Record")


@dataclass(frozen=True)
class Rebuilt:
    """Which records were rebuilt, and how many jobs were found past their time and dropped."""

    jobs: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    dropped: int = 0


class Rebuilder:
    """Safe to run at any time, by several machines at once: what Redis knows is left as it is."""

    def __init__(self, records: JournaledRecordStore, queue: JobQueue, blobs: BlobStore) -> None:
        self._records = records
        self._queue = queue
        self._blobs = blobs

    def run_if_needed(self) -> Rebuilt:
        """Read the journal unless Redis holds all of it. Raises RedisError, OSError; then the next call begins
        again."""
        if self._records.generation.is_current():
            return Rebuilt()
        token = self._records.generation.begin()
        rebuilt = self._run()
        if self._records.generation.end(token) and (rebuilt.jobs or rebuilt.fields):
            logger.warning("from the journal: %d jobs and %d fields", len(rebuilt.jobs), len(rebuilt.fields))
        return rebuilt

    def _run(self) -> Rebuilt:
        fields = list(_in_pages(self._records.journal.fields(), self._records.recall_field))
        for field in fields:
            if field.state == "validating":
                self._queue.enqueue_import(field.sha256, field.attempt)
        jobs = list(_in_pages(self._records.journal.jobs(), self._recall_job))
        found = [job for job in jobs if isinstance(job, JobRecord)]
        for job in sorted(found, key=lambda one: (one.updated, one.id)):
            if job.status == "accepted":
                self._queue.enqueue_registration(job.id, job.attempt, job.owner, job.is_of_batch)
        return Rebuilt(
            tuple(job.id for job in found), tuple(field.sha256 for field in fields), dropped=len(jobs) - len(found)
        )

    def _recall_job(self, job_id: str) -> JobRecord | str | None:
        """A record that was rebuilt; the id of a job that was dropped; None where nothing was to be done."""
        now = self._records.now()
        job = self._records.journal.recall(job_id, now)
        if job is None:
            return None
        if self._records.has_expired(job, now):
            if self._is_known(job_id):
                return None  # it was requested again
            self._blobs.delete_prefix(f"jobs/{job_id}")
            self._records.journal.forget(job_id)
            return job_id
        return job if self._records.restore_job(job) else None

    def _is_known(self, job_id: str) -> bool:
        try:
            return self._records.get_job(job_id) is not None
        except UnreadableRecordError:
            return True


def _in_pages(names: Iterable[str], recall: Callable[[str], _Record | None]) -> Iterator[_Record]:
    left = iter(names)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        while page := list(islice(left, _PAGE)):
            yield from (found for found in pool.map(recall, page) if found is not None)

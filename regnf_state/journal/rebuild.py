"""Rebuilding the records from the journal after Redis has lost them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.queue import JobQueue
from regnf_state.records import JobRecord, UnreadableRecordError

_AT_ONCE = 16
_PAGE = 1000
_Record = TypeVar("_Record")
logger = logging.getLogger(__name__)


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
        """Read the journal unless Redis holds all of it. Raises RedisError, OSError; then the next call begins anew."""
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
                return None  # it was asked for again
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
    """What ``recall`` finds for each name, a page of names at a time, several at once."""
    left = iter(names)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        while page := list(islice(left, _PAGE)):
            yield from (found for found in pool.map(recall, page) if found is not None)

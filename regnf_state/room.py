"""Room for new records: what is kept of each caller is bounded, and a nearly full Redis keeps a reserve.

A caller has at most so many finished jobs, and so have all together. Beyond that the oldest finished ones go, with
their results: the caller's own, or those of the caller that has most. When Redis has less than a reserve of its memory
left, the same happens; if that does not help, nothing new is taken: first of whoever has most, then of anybody. What
ends, deletes or reports is never refused here. Counts stand for bytes: transitions.finished_job bounds a record.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from redis import Redis

from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.originals import Originals, delete_upload
from regnf_state.records import RecordsFullError, StaleAttemptError, UnreadableRecordError
from regnf_state.redis import counters
from regnf_state.redis.owners import Owners
from regnf_state.settings import Settings

_AT_ONCE = 32
"""Evictions for one request."""
_A_ROUND = 1000
_REJECTED_KEPT = 1000
"""Records of rejected fields of one caller."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Memory:
    """Of Redis, in bytes; ``most`` 0: no limit."""

    used: int
    most: int

    def is_below(self, share: float) -> bool:
        """Whether less than this share of it is left."""
        return self.most > 0 and self.most - self.used < share * self.most


class Room:
    """Makes room, or says that there is none. Any number of processes may use it at once."""

    def __init__(self, records: JournaledRecordStore, blobs: BlobStore, redis: Redis, settings: Settings) -> None:
        self._records = records
        self._blobs = blobs
        self._redis = redis
        self._owners = Owners(redis)
        self._of_caller = settings.quota_finished_jobs
        self._of_all = settings.max_finished_jobs
        self._reserve = settings.redis_reserve
        self._originals = Originals(records, blobs, settings)

    def make(self, owner: str) -> None:
        """Make room for one more record of this caller. Raises RecordsFullError, RedisError, OSError."""
        self._evict(owner, min(_AT_ONCE, self._owners.finished(owner) + 1 - self._of_caller))
        self._evict_greediest(min(_AT_ONCE, self._owners.finished() + 1 - self._of_all))
        self._drop_rejected(owner)
        if not self.memory().is_below(self._reserve):
            return
        self._evict_greediest(_AT_ONCE)
        memory = self.memory()
        if memory.is_below(self._reserve / 2) or (
            memory.is_below(self._reserve) and owner == self._owners.greediest(self._owners.held)
        ):
            raise RecordsFullError("Redis has less than its reserve of memory left")

    @property
    def is_full(self) -> bool:
        """Whether nobody's new jobs and fields are taken."""
        return self.memory().is_below(self._reserve / 2)

    def tidy(self, confirm: Callable[[], None]) -> int:
        """One round: all callers and all together within their bounds, and uploads whose time is over let go.

        How many jobs went.
        """
        self._owners.find()
        evicted = 0
        for owner in self._owners.all():
            self._originals.trim(owner)
            evicted += self._evict(owner, min(_A_ROUND, self._owners.finished(owner) - self._of_caller), confirm)
        evicted += self._evict_greediest(min(_A_ROUND, self._owners.finished() - self._of_all), confirm)
        while evicted < _A_ROUND and self.memory().is_below(self._reserve):
            gone = self._evict_greediest(_AT_ONCE, confirm)
            if not gone:
                break
            evicted += gone
        return evicted

    def memory(self) -> Memory:
        told: Any = self._redis.info("memory")
        return Memory(int(told["used_memory"]), int(told.get("maxmemory", 0)))

    def _evict_greediest(self, most: int, confirm: Callable[[], None] = lambda: None) -> int:
        if most <= 0:
            return 0
        owner = self._owners.greediest(self._owners.finished)
        return 0 if owner is None else self._evict(owner, most, confirm)

    def _evict(self, owner: str, most: int, confirm: Callable[[], None] = lambda: None) -> int:
        """Forget a caller's oldest finished jobs, ``most`` at most, results included."""
        gone = 0
        for job_id in self._owners.oldest_finished(owner, most):
            confirm()
            try:
                self._records.delete_job(job_id)
            except (StaleAttemptError, UnreadableRecordError):
                continue  # it was asked for anew, or is of a later release
            self._blobs.delete_prefix(f"jobs/{job_id}")
            self._owners.note_evicted(owner, job_id)
            counters.count(self._redis, "jobs_evicted")
            gone += 1
        if gone:
            logger.info("%d finished jobs of %s are evicted to make room", gone, owner)
        return gone

    def _drop_rejected(self, owner: str) -> None:
        """Forget a caller's oldest rejected fields beyond those that are kept."""
        for reference in self._records.rejected_beyond(owner, _REJECTED_KEPT, _AT_ONCE):
            field = self._records.get_field(reference)
            if field is None or field.state == "rejected":
                self._records.delete_field(reference)
                if field is not None and field.original_until is not None:
                    delete_upload(self._blobs, field)

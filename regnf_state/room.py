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
from regnf_state.records import FieldRecord, RecordsFullError, StaleAttemptError, UnreadableRecordError
from regnf_state.redis import counters
from regnf_state.redis.counters import Owners
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings

# Uploads that stay for a while after their import: a question of the import is then answered without a second upload.
#
# The record says until when; the bytes count towards the caller's quota, and go for a new
# upload that needs their room. Of each caller so many bytes are kept at most, the latest.

QUESTIONS = frozenset(
    {
        "LAYOUT_AMBIGUOUS",
        "HASH_GRID_NOT_RECOGNIZED",
        "TRUNCATION_UNKNOWN",
        "LATENT_MISSING",
        "FIELD_IMPLAUSIBLE",
        "SETTINGS_CONTRADICT_TENSORS",
        "INVALID_DESCRIPTION",
        "FAMILY_NOT_SUPPORTED",
        "NO_ZERO_LEVEL",
    }
)
"""Reasons of a rejection that another description of the same bytes may mend."""
_MOST = 64
"""Uploads of one caller."""


def original_key(reference: str) -> str:
    """Where the uploaded bytes lie until the import has ended, or for as long as they are kept."""
    return f"fields/{reference}/original"


def settings_key(reference: str, sha256: str) -> str:
    """Where the trainer's settings, or the cameras, that came with them lie, for as long."""
    return f"fields/{reference}/settings-{sha256}"


def candidates_prefix(reference: str) -> str:
    """Where the pictures lie of what a rejected field may be; they go with its upload."""
    return f"fields/{reference}/candidates"


def candidate_key(reference: str, number: int) -> str:
    """The picture of the ``number``-th candidate, counted from 1."""
    return f"{candidates_prefix(reference)}/{number}.png"


def delete_upload(blobs: BlobStore, field: FieldRecord) -> None:
    """Delete what was uploaded, but nothing that was made of it."""
    blobs.delete(original_key(field.sha256))
    for file in field.beside:
        blobs.delete(settings_key(field.sha256, file.sha256))


def delete_all_but_upload(blobs: BlobStore, field: FieldRecord) -> None:
    """Delete what was made of an upload, and files that came with it and are no longer its own."""
    own = {original_key(field.sha256), *(settings_key(field.sha256, file.sha256) for file in field.beside)}
    for key in list(blobs.list(f"fields/{field.sha256}")):
        if key not in own:
            blobs.delete(key)


class Originals:
    """The uploads that are kept. Any number of processes may use it at once. Methods raise RedisError, OSError."""

    def __init__(self, records: RecordStore, blobs: BlobStore, settings: Settings) -> None:
        self._records = records
        self._blobs = blobs
        self._choice = settings.keep_originals
        self._kept_s = settings.keep_originals_s
        self._most_bytes = settings.keep_originals_bytes

    def kept_until(self, rejection: str | None) -> float | None:
        """Until when the upload of a field is kept that was rejected for this reason, or (None) is ready now."""
        kept = self._choice == "all" if rejection is None else self._choice != "none" and rejection in QUESTIONS
        return round(self._records.now() + self._kept_s, 3) if kept else None

    def trim(self, owner: str) -> int:
        """Let go of those whose time is over, and of the oldest beyond what is kept; how many."""
        kept = self._kept(owner)
        now, room, gone = self._records.now(), self._most_bytes, 0
        for number, field in enumerate(reversed(kept)):
            until = field.original_until or 0.0
            room -= field.upload_bytes
            if until <= now or room < 0 or number >= _MOST:
                gone += self.drop(field)
        return gone

    def free(self, owner: str) -> bool:
        """Let go of an owner's oldest; False when there is none."""
        return any(self.drop(field) for field in self._kept(owner))

    def bytes_of(self, owner: str) -> int:
        """How many bytes an owner's kept uploads have: room that a new upload can have."""
        return sum(field.upload_bytes for field in self._kept(owner))

    def _kept(self, owner: str) -> list[FieldRecord]:
        return self._records.fields_with_original(owner)

    def drop(self, field: FieldRecord) -> bool:
        """Let go of the upload of a field whose import has ended; False when it has changed meanwhile.

        The record first: what it says is kept is there. An upload of the same bytes in between keeps its own."""
        try:
            self._records.update_field(field.sha256, attempt=field.attempt, original_until=None)
        except StaleAttemptError:
            return False
        now = self._records.get_field(field.sha256)
        if now is None or (now.attempt == field.attempt and now.state != "validating"):
            delete_upload(self._blobs, field)
            self._blobs.delete_prefix(candidates_prefix(field.sha256))
            logger.info("the upload of field %s is not kept", field.sha256)
        return True


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
            raise RecordsFullError("Redis has less free memory than its reserve")

    @property
    def is_full(self) -> bool:
        """Whether nobody's new jobs and fields are taken."""
        return self.memory().is_below(self._reserve / 2)

    def tidy(self, confirm: Callable[[], None]) -> int:
        """One round: all callers and all together within their bounds, and uploads whose time is over let go.

        How many jobs went.
        """
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
        gone = 0
        for job_id in self._owners.oldest_finished(owner, most):
            confirm()
            try:
                self._records.delete_job(job_id)
            except (StaleAttemptError, UnreadableRecordError):
                continue  # it was requested again, or is of a later release
            self._blobs.delete_prefix(f"jobs/{job_id}")
            self._owners.note_evicted(owner, job_id)
            counters.count(self._redis, "jobs_evicted")
            gone += 1
        if gone:
            logger.info("%d finished jobs of %s are deleted to free space", gone, owner)
        return gone

    def _drop_rejected(self, owner: str) -> None:
        for reference in self._records.rejected_beyond(owner, _REJECTED_KEPT, _AT_ONCE):
            field = self._records.get_field(reference)
            if field is None or field.state == "rejected":
                self._records.delete_field(reference)
                if field is not None and field.original_until is not None:
                    delete_upload(self._blobs, field)

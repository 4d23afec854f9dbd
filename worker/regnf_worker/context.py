"""What a job is given: settings and stores, made from the environment in the job's own process."""

from __future__ import annotations

from dataclasses import dataclass

from regnf_state.blobs.base import BlobStore
from regnf_state.blobs.open import open_blobs
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.queue import JobQueue
from regnf_state.records import RecordStore
from regnf_state.redis.client import connect
from regnf_state.redis.queue import RqJobQueue
from regnf_state.settings import Settings

_RETRIES = 20
"""About eighteen seconds: a job outlives a restart of Redis."""
_STORAGE_WAIT_S = 120.0


class NoRedisError(RuntimeError):
    """A worker needs to be told where Redis is."""

    reason = "REDIS_URL_MISSING"


@dataclass(frozen=True)
class Context:
    """Settings and stores of one process."""

    settings: Settings
    records: RecordStore
    blobs: BlobStore
    queue: JobQueue

    @classmethod
    def from_settings(cls, settings: Settings, existing: bool = False) -> Context:
        """Stores over Redis and the storage that the settings name. Raises NoRedisError.

        ``existing``: for a job, which makes no storage of its own where that of its worker is away.
        """
        if settings.redis_url is None:
            raise NoRedisError("set REGNF_REDIS_URL")
        redis = connect(settings.redis_url, retries=_RETRIES)
        blobs = open_blobs(settings, _STORAGE_WAIT_S, existing)
        records = JournaledRecordStore(redis, settings.retention_s, blobs)
        return cls(settings, records, blobs, RqJobQueue(redis))

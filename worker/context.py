"""What a job is given: settings and stores, made from the environment in the job's own process."""

from __future__ import annotations

from dataclasses import dataclass

from service.blobs import BlobStore
from service.local_blobs import LocalBlobStore
from service.queue import JobQueue
from service.records import RecordStore
from service.redis_client import connect
from service.redis_queue import RqJobQueue
from service.redis_records import RedisRecordStore
from service.settings import Settings

_RETRIES = 20
"""About eighteen seconds: a job outlives a restart of Redis."""


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
    def from_settings(cls, settings: Settings) -> Context:
        """Stores over Redis and a local folder. Raises NoRedisError."""
        if settings.redis_url is None:
            raise NoRedisError("set REGNF_REDIS_URL")
        redis = connect(settings.redis_url, retries=_RETRIES)
        return cls(
            settings,
            RedisRecordStore(redis, settings.retention_s),
            LocalBlobStore(settings.blob_dir),
            RqJobQueue(redis),
        )

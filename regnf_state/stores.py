"""Everything that a process of the service keeps state in, opened as the settings say."""

from __future__ import annotations

from dataclasses import dataclass

from redis import Redis

from regnf_state.blobs.base import BlobStore
from regnf_state.blobs.local import open_blobs
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.redis.bounded_client import connect_bounded
from regnf_state.redis.client import connect, redis_address
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings


@dataclass(frozen=True)
class Stores:
    """Records and queue in one Redis, and blobs."""

    redis: Redis
    records: JournaledRecordStore
    blobs: BlobStore
    queue: JobQueue


def open_stores(settings: Settings, *, retries: int | None, storage_wait_s: float, existing: bool = False) -> Stores:
    """The stores that the settings name. Raises NoRedisError.

    A command to Redis is tried again ``retries`` times; None: for four seconds at most, and not at all while Redis
    gives no answer. A storage that is away is waited for ``storage_wait_s`` seconds. ``existing``: for a job, which
    makes no storage of its own where that of its worker is away.
    """
    url = redis_address(settings)
    redis = connect_bounded(url) if retries is None else connect(url, retries=retries)
    blobs = open_blobs(settings, storage_wait_s, existing)
    records = JournaledRecordStore(redis, settings.job_retention_s, blobs)
    return Stores(redis, records, blobs, JobQueue(redis, settings.queue_key))

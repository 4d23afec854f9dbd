"""A job and an import over the real stores, as a worker's process finds them."""

from __future__ import annotations

from redis import Redis

from regnf_state.records import FieldRecord, JobRecord
from regnf_state.settings import Settings
from regnf_worker.models import Context
from tests.requests import request_record
from tests.stores import HeldBlobs, ShiftedRecords, WatchedQueue

SHA = "a" * 64


def context_over(redis: Redis, settings: Settings) -> Context:
    """What a job is given, over an emptied Redis and a folder; without a journal."""
    redis.flushall()
    return Context(settings, ShiftedRecords(redis), HeldBlobs(settings.blob_dir), WatchedQueue(redis))


def accept(context: Context, do: str = "succeed") -> None:
    now = context.records.now()
    if context.records.get_field(SHA) is None:
        context.records.create_field(FieldRecord(SHA, "ready", 1, now, now))
        context.blobs.put(f"fields/{SHA}/field.safetensors", b"f")
    request = request_record(SHA, SHA, do)
    context.records.create_job(JobRecord("j1", "registration", "accepted", request, {}, now, now), 10)


def job(context: Context) -> JobRecord:
    record = context.records.get_job("j1")
    assert record is not None
    return record


def ending(context: Context) -> tuple[str, str | None]:
    """The job's status, and the reason of its error."""
    return job(context).status, (job(context).error or {}).get("reason")


def begin_import(context: Context, data: bytes = b"f") -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    context.blobs.put(f"fields/{SHA}/original", data)


def field(context: Context) -> FieldRecord:
    record = context.records.get_field(SHA)
    assert record is not None
    return record

"""What was accepted and what became of it, in the blob store: enough to rebuild the records when Redis has lost them.

One folder a job, objects in it that are written once and never changed:
    journal/jobs/{id}/{attempt}-accepted    the record as it was accepted; written before the caller is told
    journal/jobs/{id}/{attempt}-begun       a later attempt will be claimed now; it counts as an attempt
    journal/jobs/{id}/{attempt}-ended       the record as it ended
    journal/jobs/{id}/{attempt}-webhooks{n} the record with n webhooks of later requests, before those are answered
One object a field, the record as it was last written: journal/fields/{reference}.
"""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from typing import Any, TypeVar
from uuid import uuid4

from redis import Redis

from regnf_state.blobs.base import BlobStore
from regnf_state.records import (
    FORMAT,
    FieldRecord,
    JobRecord,
    UnreadableRecordError,
    check_json_format,
    decoded,
    document_of,
)
from regnf_state.redis.documents import text
from regnf_state.redis.unreadable import PREFIX

_JOBS = "journal/jobs"
_FIELDS = "journal/fields"
_STORAGE_ID = "journal/storage-id"
_WEBHOOKS = "webhooks"
_AT_ONCE = 16
"""Writes: on ext4 a thousand take 0.5 s, one after the other 8 s."""
_BESIDE = frozenset({"format", "owner"})
"""Members of a document that are no members of the record."""
_Record = TypeVar("_Record", JobRecord, FieldRecord)
logger = logging.getLogger(__name__)


def _folder(job_id: str) -> str:
    return f"{_JOBS}/{job_id}"


class Journal:
    """The journal of one blob store. Everything may raise OSError."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs

    def storage_id(self) -> str:
        """An id that no other store has, made by the first call."""
        self._blobs.put_if_absent(_STORAGE_ID, uuid4().hex.encode())
        with self._blobs.open(_STORAGE_ID) as file:
            return file.read().decode()

    # jobs

    def accept(self, jobs: Sequence[JobRecord]) -> None:
        """All of them are kept when this returns, however many attempts of each there are."""
        _at_once(self._accept, jobs)

    def _accept(self, job: JobRecord) -> None:
        if self._write(job, "accepted"):
            self._forget_before(job)
        elif not self._holds(job):
            self.forget(job.id)  # a job of this id that has outlived its retention, or that cannot be read
            self._write(job, "accepted")

    def _forget_before(self, job: JobRecord) -> None:
        """Drop what is said of attempts before this one: a job that is requested again and again must not grow."""
        for key in list(self._blobs.list(_folder(job.id))) if job.attempt > 1 else ():
            if int(key.rpartition("/")[2].partition("-")[0]) < job.attempt:
                self._blobs.delete(key)

    def _holds(self, job: JobRecord) -> bool:
        """Whether what is written of this attempt is of this job. Raises UnreadableRecordError: of a later release."""
        try:
            return self._read(job.id, job.attempt, "accepted").created == job.created
        except UnreadableRecordError as error:
            if error.newer:
                raise
            logger.error("%s in the journal: written again", error)
            return False

    def join(self, jobs: Sequence[JobRecord]) -> None:
        """Keep the webhooks that later requests have added to these jobs."""
        _at_once(lambda job: self._write(job, f"{_WEBHOOKS}{len(job.more_webhooks)}"), jobs)

    def begin(self, job_id: str, attempt: int) -> None:
        self._blobs.put_if_absent(f"{_folder(job_id)}/{attempt:06d}-begun", b"")
        self._blobs.delete(f"{_folder(job_id)}/{attempt - 1:06d}-begun")  # the highest number is all that counts

    def end(self, job: JobRecord) -> None:
        self._write(job, "ended")

    def _write(self, job: JobRecord, event: str) -> bool:
        document = _text(job, owner=job.owner)
        return self._blobs.put_if_absent(f"{_folder(job.id)}/{job.attempt:06d}-{event}", document)

    def forget(self, job_id: str) -> None:
        self._blobs.delete_prefix(_folder(job_id))

    def jobs(self) -> Iterator[str]:
        """The ids of all jobs, sorted; listed a page at a time."""
        keys = (key.removeprefix(f"{_JOBS}/").split("/") for key in self._blobs.list(_JOBS))
        return (job_id for job_id, _ in groupby(parts[0] for parts in keys))

    def accepted(self, job_id: str) -> JobRecord | None:
        """The job as it was last accepted, with all of its request; None where nothing is written that can be read."""
        keys = [key for key in self._blobs.list(_folder(job_id)) if key.endswith("-accepted")]
        try:
            return self._read(job_id, int(max(keys).rpartition("/")[2].partition("-")[0]), "accepted") if keys else None
        except UnreadableRecordError as error:
            logger.error("%s in the journal", error)
            return None

    def recall(self, job_id: str, now: float) -> JobRecord | None:
        """The job as it continues: ended as it did, or to be run as an attempt that did not exist before."""
        try:
            return self._recall(job_id, now)
        except (ValueError, UnreadableRecordError) as error:
            logger.error("the journal of job %s cannot be read: %s", job_id, error)
            return None

    def _recall(self, job_id: str, now: float) -> JobRecord | None:
        events = [key.rpartition("/")[2].split("-") for key in self._blobs.list(_folder(job_id))]
        attempts = {event: [int(number) for number, name in events if name == event] for _, event in events}
        if "accepted" not in attempts:
            return None
        accepted, latest = max(attempts["accepted"]), max(int(number) for number, _ in events)
        joined = [(int(n), name) for n, name in events if name.startswith(_WEBHOOKS) and int(n) >= accepted]
        ended = max(attempts.get("ended", [0]))
        kept = (ended, "ended") if ended >= accepted else (accepted, "accepted")
        job = replace(self._read(job_id, *kept), more_webhooks=self._more_webhooks(job_id, [kept, *joined]))
        if kept[1] == "ended":
            return job
        if self._blobs.exists(f"jobs/{job_id}/manifest.json"):
            return replace(job, status="successful", attempt=latest, progress=1.0, updated=now, finished=now)
        return replace(job, attempt=latest + 1)

    def _more_webhooks(self, job_id: str, events: Iterable[tuple[int, str]]) -> list[str]:
        """Those of whichever event has most: a job keeps what was added to it."""
        return max((self._read(job_id, *event).more_webhooks for event in events), key=len)

    def _read(self, job_id: str, attempt: int, event: str) -> JobRecord:
        with self._blobs.open(f"{_folder(job_id)}/{attempt:06d}-{event}") as file:
            return replace(_as_record(JobRecord, job_id, file.read()), version=1)

    # fields

    def keep_field(self, field: FieldRecord) -> None:
        self._blobs.put(f"{_FIELDS}/{field.sha256}", _text(field))

    def forget_field(self, reference: str) -> None:
        self._blobs.delete(f"{_FIELDS}/{reference}")

    def fields(self) -> Iterator[str]:
        """The references of all fields, sorted; listed a page at a time."""
        return (key.removeprefix(f"{_FIELDS}/") for key in self._blobs.list(_FIELDS))

    def recall_field(self, reference: str) -> FieldRecord | None:
        """The field as it continues; None when there is none, or its bytes are gone."""
        try:
            with self._blobs.open(f"{_FIELDS}/{reference}") as file:
                field = replace(_as_record(FieldRecord, reference, file.read()), version=1)
        except FileNotFoundError:
            return None
        except UnreadableRecordError as error:
            logger.error("the journal of field %s cannot be read: %s", reference, error)
            return None
        if field.state == "rejected" or self._blobs.exists(f"fields/{reference}/field.safetensors"):
            # an import that was not written down as ended finds its own report, and ends at once
            return field if field.state != "validating" else replace(field, attempt=field.attempt + 1)
        if field.state == "validating" and self._blobs.exists(f"fields/{reference}/original"):
            return replace(field, attempt=field.attempt + 1)
        return None


def _at_once(write: Callable[[JobRecord], object], jobs: Sequence[JobRecord]) -> None:
    """Write of each job, several at once: most of the time a disk is waited for, which does the work of all together.

    Raises what the first failing one raised, once all others have ended.
    """
    each = {(job.id, job.attempt, len(job.more_webhooks)): job for job in jobs}
    if len(each) == 1:
        write(jobs[0])
    elif each:
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            deque(pool.map(write, each.values()), maxlen=0)


def _text(record: JobRecord | FieldRecord, **beside: str) -> bytes:
    return json.dumps(document_of(record) | beside | {"format": FORMAT}, separators=(",", ":")).encode()


def _as_record(kind: type[_Record], name: str, text: bytes) -> _Record:
    try:
        document = json.loads(text)
    except ValueError as error:
        raise UnreadableRecordError(name, "it is not JSON") from error
    document = check_json_format(name, document)
    return decoded(kind, name, json.dumps({key: value for key, value in document.items() if key not in _BESIDE}))


# One Redis belongs to one storage: two services over one Redis, with a storage each, would mix their jobs silently.
#
# A storage has an id, made once and kept in it. Redis notes the id of the storage whose records it holds. A process
# whose storage has another id refuses to start. A Redis that holds nothing yet, or that was emptied, takes the first
# id.

STORAGE_KEY = f"{PREFIX}storage"
GENERATION_KEY = f"{PREFIX}generation"


class StorageMismatchError(RuntimeError):
    """The records in Redis are of another storage."""

    reason = "STORAGE_MISMATCH"


def claim_storage(redis: Redis, storage_id: str, adopt: str | None = None) -> None:
    """Note that this Redis belongs to the storage of this id. Raises StorageMismatchError, RedisError.

    ``adopt``: what the operator says: the id of the storage that shall have this Redis from now on.
    """
    redis.set(STORAGE_KEY, storage_id, nx=True)
    noted: Any = redis.get(STORAGE_KEY)
    known = text(noted) if noted is not None else storage_id
    if known == storage_id:
        return
    if adopt == storage_id:
        redis.set(STORAGE_KEY, storage_id)
        redis.delete(GENERATION_KEY)  # the journal of this storage is read now
        logger.warning("this Redis belonged to the storage %s; it now belongs to the storage %s", known, storage_id)
        return
    raise StorageMismatchError(
        f"this Redis has the records of the storage {known}, but the storage here is {storage_id}. Check "
        "REGNF_REDIS_URL, REGNF_STORAGE_URL and REGNF_STATE_DIR: all processes of a service need the same values. To "
        f"use this Redis with this storage, start once with REGNF_ADOPT_STORAGE={storage_id}"
    )

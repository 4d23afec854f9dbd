"""The record store in Redis. What a record may become is in ``transitions``; here it is only kept.

Keys:  regnf:job:{id}             hash: the record          regnf:jobs:created    sorted by time of creation,
                                                            also one for each owner, :{owner}
       regnf:job:{id}:events      stream                    regnf:jobs:active     set of accepted and running
       regnf:job:{id}:gone        tombstone: the owner      regnf:jobs:expiring   sorted by time of expiry
       regnf:field:{sha256}       hash: the record
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state import transitions
from regnf_state.ownership import ANONYMOUS, owner_of
from regnf_state.record_store import Page, Position
from regnf_state.records import (
    ACTIVE,
    FINISHED,
    NO_QUOTA,
    JobEvent,
    JobNews,
    JobRecord,
    QueueFullError,
    Quota,
    QuotaError,
    RecordError,
    StaleAttemptError,
    UnreadableRecordError,
)
from regnf_state.redis import counters
from regnf_state.redis import webhook_outbox as outbox
from regnf_state.redis.counters import OWNERS
from regnf_state.redis.documents import (
    Cap,
    Change,
    Command,
    Kind,
    ask,
    is_wrong_type,
    owned_key,
    stored_in,
    text,
    unless_wrong_type,
)
from regnf_state.redis.fields import RedisLibrary
from regnf_state.redis.unreadable import PREFIX, Stored

# A job's events in Redis: a stream, read by XREAD.


def start_of(after: str | None) -> str:
    """Where XREAD begins. Raises ValueError when ``after`` is no event id."""
    return "{}-{}".format(*transitions.parse_event_id(after)) if after is not None else "0-0"


def events_in(answer: Any) -> list[JobEvent]:
    """The events in an answer to XREAD about one stream, in either protocol's shape; none where it is no stream."""
    told = unless_wrong_type(answer, [])
    if isinstance(told, dict):
        chunks = [chunk for chunks in told.values() for chunk in chunks]
    else:
        chunks = [chunk for _, chunk in told or []]
    return [_event(entry) for chunk in chunks for entry in chunk]


def _event(entry: tuple[bytes | str, dict[bytes | str, bytes | str]]) -> JobEvent:
    identifier, fields = entry
    values = {text(name): text(value) for name, value in fields.items()}
    return JobEvent(text(identifier), values["name"], json.loads(values["data"]))


_CREATED = f"{PREFIX}jobs:created"
_ACTIVE = f"{PREFIX}jobs:active"
_EXPIRING = f"{PREFIX}jobs:expiring"
_EVENTS_KEPT = "1000"
_EVENTS_KEPT_AT_END = "8"
"""Whoever asks late is told of the end and of what came just before it."""

_EXPIRE = """
local expires = redis.call('ZSCORE', KEYS[1], ARGV[1])
if not expires or tonumber(expires) > tonumber(ARGV[2]) then return 0 end
redis.call('ZREM', KEYS[1], ARGV[1])
redis.call('ZREM', KEYS[2], ARGV[1])
local owner = redis.pcall('GET', KEYS[5])
if type(owner) == 'string' then redis.call('ZREM', KEYS[2] .. ':' .. owner, ARGV[1]) end
redis.call('DEL', KEYS[3], KEYS[4])
return 1
"""


JOB = Kind("job", JobRecord)


def _created_keys(record: JobRecord) -> tuple[str, str]:
    return _CREATED, f"{_CREATED}:{record.owner}"


def _caps(owner: str, max_active: int, quota: Quota) -> list[Cap]:
    caps: list[Cap] = [("SCARD", _ACTIVE, 1, max_active, "FULL")]
    if quota.active_jobs is not None:
        caps.append(("SCARD", owned_key(owner, "active"), 1, quota.active_jobs, "QUOTA_ACTIVE_JOBS"))
    elif quota.share_jobs:
        # no more than stay free: one greedy owner gets half of all, two get a third each
        caps.append(("SCARD", f"{owned_key(owner, 'active')} {_ACTIVE}", 1, max_active, "QUOTA_ACTIVE_JOBS"))
    return caps


class RecordStore(RedisLibrary):
    """Where records live. Any number of processes share it; its clock is the Redis server's.

    Every method blocks; the API calls them off the event loop or through short threads.
    """

    def __init__(self, redis: Redis, retention_s: int = 7 * 24 * 3600) -> None:
        super().__init__(redis)
        self._retention_s = retention_s
        self._expire = redis.register_script(_EXPIRE)

    def set_if_absent(self, key: str, value: str, ttl_s: int, owner: str = ANONYMOUS) -> str:
        """Bind ``value`` to ``key`` for ``ttl_s`` seconds unless it is bound already; returns what is bound. Atomic.

        It counts as one of the owner's, who has ten thousand at most: beyond that the oldest is forgotten.
        """
        name = f"{PREFIX}once:{key}"
        known = self._redis.set(name, value, nx=True, get=True, ex=ttl_s)
        if known is None:
            self.owners.bound(owner, "once", name, ttl_s)
        return value if known is None else text(known)  # type: ignore[arg-type]

    def _commands(self, before: JobRecord | None, after: JobRecord) -> list[Command]:
        key, events, gone = (f"{JOB.key(after.id)}{part}" for part in ("", ":events", ":gone"))
        commands: list[Command] = [
            *(("ZADD", each, repr(after.created), after.id) for each in _created_keys(after)),
            ("SADD", OWNERS, after.owner),
            *(
                ("SADD" if after.status in ACTIVE else "SREM", each, after.id)
                for each in (_ACTIVE, owned_key(after.owner, "active"))
            ),
        ]
        commands += counters.of_job(before, after)
        event = transitions.event_of(before, after)
        if event is not None:
            name, data = event
            commands.append(("XADD", events, "MAXLEN", "~", _EVENTS_KEPT, "*", "name", name, "data", json.dumps(data)))
        if after.status == "accepted":
            commands.append(("COMPACT", events))  # it may wait for long
        if after.finished is not None:
            expires = after.finished + self._retention_s
            commands.append(("ZADD", _EXPIRING, repr(expires), after.id))
            until = str(int((expires + self._retention_s) * 1000))
            commands.append(("SET", gone, after.owner, "PXAT", until))
            commands += [("XTRIM", events, "MAXLEN", _EVENTS_KEPT_AT_END), ("COMPACT", events)]
            commands += [("PEXPIREAT", each, str(int(expires * 1000))) for each in (key, events)]
            commands += outbox.entering(before, after, expires)
        else:
            commands += [("PERSIST", each) for each in (key, events)]
            commands += outbox.forgetting(before) if before is not None and before.finished is not None else []
            commands += [("ZREM", _EXPIRING, after.id), ("DEL", gone)]
        return commands

    def _change_job(self, job_id: str, change: Callable[[JobRecord, float], JobRecord]) -> JobRecord:
        while True:
            known, now = self._current_job(job_id)
            changed = change(known, now)
            if changed is known:
                return known
            commands = self._commands(known, changed)
            if self._compare_and_set(JOB.key(job_id), known.version, commands, changed) == "OK":
                if changed.status in FINISHED:
                    self._note_end(changed)
                return changed

    def _note_end(self, job: JobRecord) -> None:
        """A job has ended."""

    def _current_job(self, job_id: str) -> tuple[JobRecord, float]:
        try:
            known, now = self._read(JOB, job_id)
        except UnreadableRecordError as error:
            raise StaleAttemptError(str(error)) from error
        if known is None:
            raise StaleAttemptError("there is no such job")
        return known, now

    def _heal(self, kind: Kind[Any], name: str, stored: Stored, error: UnreadableRecordError) -> None:
        super()._heal(kind, name, stored, error)
        if kind is JOB and not error.newer:
            self._redis.srem(_ACTIVE, name)

    def owns(self, owner: str, job_id: str) -> bool:
        """Whether the owner's jobs list it, even if its record cannot be read."""
        return self._redis.zscore(f"{_CREATED}:{owner}", job_id) is not None

    def create_job(self, record: JobRecord, max_active: int, quota: Quota = NO_QUOTA) -> tuple[JobRecord, bool]:
        """Store a new job, or return the one that exists under its id (False).

        A finished job that failed or was dismissed is started again as the next attempt (True): enqueue what is
        returned, with its attempt. A webhook of ``record`` that the job does not have yet is added to it, and told at
        once if the job has finished. Atomic. Raises QueueFullError when ``max_active`` jobs are active already,
        QuotaError when the owner, or the job of webhooks, has as many as it may.
        """
        (answer,) = self.create_jobs([record], max_active, quota)
        if isinstance(answer, RecordError):
            raise answer
        return answer

    def create_jobs(
        self, records: Sequence[JobRecord], max_active: int, quota: Quota = NO_QUOTA
    ) -> list[tuple[JobRecord, bool] | RecordError]:
        """The same for several, in a few round trips: a refusal takes the place of a job that is refused."""
        answers: dict[int, tuple[JobRecord, bool] | RecordError] = {}
        while left := [place for place in range(len(records)) if place not in answers]:
            stored, now = self._fetch_now(JOB, [records[place].id for place in left])
            changes: dict[int, tuple[Change, tuple[JobRecord, bool]]] = {}
            for place, (name, held) in zip(left, stored, strict=True):
                record = records[place]
                try:
                    known = self._before(JOB, name, held)
                    fresh = transitions.restarted_job(known, record, now) if known is not None else record
                    after = fresh or transitions.joined_job(cast(JobRecord, known), record)
                except RecordError as error:
                    answers[place] = error
                    continue
                if after is known:
                    answers[place] = after, False
                    continue
                version = known.version if known is not None else 0
                caps = _caps(record.owner, max_active, quota) if fresh else ()
                change = Change(JOB.key(name), version, self._commands(known, after), after, caps)
                changes[place] = change, (after, fresh is not None)
            said = self._compare_and_set_each([change for change, _ in changes.values()])
            for (place, (_, done)), word in zip(changes.items(), said, strict=True):
                if word == "OK":
                    answers[place] = done
                elif word == "FULL":
                    answers[place] = QueueFullError(f"{max_active} jobs are active already")
                elif word.startswith("QUOTA") and not self._forget_ended(records[place].owner):
                    answers[place] = QuotaError(word)
        return [answers[place] for place in range(len(records))]

    def _forget_ended(self, owner: str) -> bool:
        """Strike jobs off an owner's active ones that are not active: records that were set aside. Whether any was."""
        key = owned_key(owner, "active")
        ended: Any = self._redis.sdiff([key, _ACTIVE])
        return bool(ended) and bool(self._redis.srem(key, *ended))

    def restore_job(self, record: JobRecord) -> bool:
        """Put a record that was lost back as it is; False when the job is known."""
        commands = self._commands(None, record)
        return self._compare_and_set(JOB.key(record.id), 0, commands, record) == "OK"

    def get_job(self, job_id: str) -> JobRecord | None:
        found, _ = self._read(JOB, job_id)
        if found is None:
            self._require_known(JOB, job_id)
        return found

    def get_jobs(self, job_ids: Sequence[str]) -> list[JobRecord | UnreadableRecordError | None]:
        """Several jobs in one round trip, in the order requested; one that cannot be read keeps no other back."""
        found = {name: self._held(name, stored) for name, stored in self._fetch_now(JOB, job_ids)[0]}
        damaged = self.unreadable.among([JOB.key(name) for name, held in found.items() if held is None])
        for name in found:
            if JOB.key(name) in damaged:
                found[name] = UnreadableRecordError(name, "it was damaged")
        return [found[name] for name in job_ids]

    def _held(self, job_id: str, stored: Stored | None) -> JobRecord | UnreadableRecordError | None:
        try:
            return self._record(JOB, job_id, stored)
        except UnreadableRecordError as error:
            return error

    def active_among(self, job_ids: Sequence[str]) -> set[str]:
        """Which of these jobs wait or run, without reading their records. Redis may have lost some."""
        return {name for name, held in zip(job_ids, self._are_active(job_ids), strict=True) if held}

    def _are_active(self, job_ids: Sequence[str]) -> list[int]:
        try:
            return cast(list[int], self._redis.smismember(_ACTIVE, list(job_ids))) if job_ids else []
        except ResponseError as error:
            if not is_wrong_type(error):
                raise
            return [0] * len(job_ids)  # a damaged index holds nothing

    def room_for_jobs(self, owner: str, max_active: int, quota: Quota) -> tuple[int, str]:
        """How many jobs ``create_job`` takes of the owner now, and the reason that one more is refused for."""
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.scard(_ACTIVE)
            pipeline.scard(owned_key(owner, "active"))
            every, own = (held if isinstance(held, int) else 0 for held in pipeline.execute(raise_on_error=False))
        of_owner = max_active
        if quota.active_jobs is not None:
            of_owner = quota.active_jobs - own
        elif quota.share_jobs:
            of_owner = (max_active - own - every + 1) // 2  # each new one leaves two fewer: see ``create_job``
        if of_owner <= 0 and self._forget_ended(owner):
            return self.room_for_jobs(owner, max_active, quota)
        reason = "QUOTA_ACTIVE_JOBS" if of_owner < max_active - every else "QUEUE_FULL"
        return max(0, min(of_owner, max_active - every)), reason

    def job_expired(self, job_id: str, owner: str = ANONYMOUS) -> bool:
        """Whether a job of this id and owner was kept once and has outlived its retention."""
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.exists(JOB.key(job_id))
            pipeline.get(f"{JOB.key(job_id)}:gone")
            held, gone = pipeline.execute()
        if held:
            return False
        return (gone is not None and text(gone) == owner) or self.owners.was_evicted(owner, job_id)

    def list_jobs(
        self, status: str | None, limit: int, before: Position | None, owner: str | None = None
    ) -> Page[JobRecord]:
        """Newest first, older than ``before`` = (created, id); ``owner`` None: everybody's."""
        index = _CREATED if owner is None else f"{_CREATED}:{owner}"
        return self._page(index, JOB, limit, before, lambda record: status in (None, record.status))

    def update_job(self, job_id: str, attempt: int, **changes: Any) -> JobRecord:
        """Compare-and-set: applies ``changes`` if ``attempt`` is current and the state machine allows it.

        A change of status must be a move: the second attempt to set ``running`` fails, so it serves as a claim.
        Raises StaleAttemptError. Publishes an event whenever status, phase or progress changes.
        """
        return self._change_job(job_id, lambda known, now: transitions.changed_job(known, attempt, changes, now))

    def heartbeat(self, job_id: str, attempt: int) -> JobRecord:
        """Say that the running attempt lives; the record returned tells whether to stop. Raises StaleAttemptError."""
        return self._change_job(job_id, lambda known, now: transitions.with_heartbeat(known, attempt, now))

    def requeue_job(self, job_id: str, attempt: int, *, lost: bool = True) -> JobRecord:
        """A running job back to accepted as its next attempt, fencing the old one off. Raises StaleAttemptError.

        ``lost``: its worker vanished, which counts in ``requeues``; otherwise the worker gave it back in good order.
        """
        return self._change_job(job_id, lambda known, now: transitions.requeued_job(known, attempt, now, lost))

    def request_cancel(self, job_id: str) -> JobRecord | None:
        """Set cancel_requested; an accepted job is dismissed at once, a running one when its worker notices."""
        try:
            return self._change_job(job_id, transitions.cancelled_job)
        except StaleAttemptError:
            return None

    def delete_job(self, job_id: str) -> bool:
        """Forget a finished job wholly; False when there is none. Raises StaleAttemptError while it is active."""
        while True:
            known, _ = self._read_to_create(JOB, job_id)
            if known is not None and known.status in ACTIVE:
                raise StaleAttemptError(f"a job that is {known.status} is not deleted")
            version = known.version if known is not None else 0
            commands: list[Command] = [("DEL", JOB.key(job_id), f"{JOB.key(job_id)}:events", f"{JOB.key(job_id)}:gone")]
            indexes = [_CREATED, _EXPIRING]
            if known is not None:
                indexes.append(_created_keys(known)[1])
                commands += outbox.forgetting(known)
            commands += [("ZREM", index, job_id) for index in indexes]
            if self._compare_and_set(JOB.key(job_id), version, commands) == "OK":
                return known is not None

    def active_jobs(self) -> list[JobRecord]:
        """Every accepted or running job."""
        names = sorted(text(name) for name in self._redis.smembers(_ACTIVE))
        return self._read_many(JOB, names)

    def expire_jobs(self) -> list[str]:
        """Delete what is left of finished jobs after their retention; their ids, so that their files go too."""
        now = self.now()
        expired = []
        names: Any = self._redis.zrangebyscore(_EXPIRING, "-inf", now)
        for job_id in map(text, names):
            keys = [_EXPIRING, _CREATED, JOB.key(job_id), f"{JOB.key(job_id)}:events", f"{JOB.key(job_id)}:gone"]
            if self._expire(keys=keys, args=[job_id, now]):
                expired.append(job_id)
        return expired

    def events(self, job_id: str, after: str | None) -> list[JobEvent]:
        """Events after the given id (None: from the start). Raises ValueError when ``after`` is no event id."""
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.xread({f"{JOB.key(job_id)}:events": start_of(after)})
            (answer,) = pipeline.execute(raise_on_error=False)
        return events_in(answer)

    def news(self, positions: Sequence[tuple[str, str | None]]) -> list[JobNews]:
        """For each (job id, event id): the job, and its events after that one. One round trip for all of them."""
        with self._redis.pipeline(transaction=False) as pipeline:
            for job_id, after in positions:
                ask(pipeline, JOB.key(job_id))
                pipeline.xread({f"{JOB.key(job_id)}:events": start_of(after)})
            answers = pipeline.execute(raise_on_error=False)
        found = zip(positions, map(stored_in, answers[::2]), answers[1::2], strict=True)
        return [JobNews(self._readable(JOB, name, held), events_in(entries)) for (name, _), held, entries in found]

    def jobs_using_field(self, sha256: str) -> Iterator[str]:
        """Ids of active jobs that need this field."""
        names = sorted(map(text, self._redis.smembers(owned_key(owner_of(sha256), "active"))))
        for name, _, stored in self._fetch_in_portions(JOB, names):
            record = self._readable(JOB, name, stored)
            if record is not None and sha256 in (*transitions.fields_of(record), *record.inputs.values()):
                yield record.id

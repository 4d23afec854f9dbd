"""The messages that are still to be sent, in Redis: entered together with the end of a job, so that none is lost.

A job has a message for each of its webhooks, named by the job, its attempt and the webhook's place among them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from redis import Redis

from regnf_state.record_format import LAST_TIME
from regnf_state.records import JobRecord
from regnf_state.redis.counters import count
from regnf_state.redis.documents import Command, is_wrong_type, text
from regnf_state.redis.keys import PREFIX

logger = logging.getLogger(__name__)
_DUE = f"{PREFIX}webhooks:due"
_LEASE_S = 60
"""A message that was taken and neither delivered nor put off for so long was taken by a process that died."""
_CLAIM = """
local time = redis.call('TIME')
local now = time[1] + time[2] / 1e6
local due = redis.call('ZRANGEBYSCORE', KEYS[1], '-inf', now, 'LIMIT', 0, 1)
if not due[1] then return false end
redis.call('ZADD', KEYS[1], now + ARGV[1], due[1])
return due[1]
"""
_SETTLE = """
if ARGV[1] == '' then redis.call('ZREM', KEYS[1], ARGV[2]) else redis.call('ZADD', KEYS[1], 'XX', ARGV[1], ARGV[2]) end
if redis.pcall('HGET', KEYS[2], 'message') == ARGV[2] then redis.call('HSET', KEYS[2], unpack(ARGV, 3)) end
"""


DeliveryState = Literal["waiting", "pending", "delivered", "failed"]


@dataclass(frozen=True)
class Delivery:
    """The state of the message about a job's end. Times are the store's, seconds since the epoch."""

    state: DeliveryState = "waiting"
    """waiting for the job's end; to be sent; received; given up."""
    sends: int = 0
    last_status: int | None = None
    last_error: str | None = None
    next_at: float | None = None
    delivered_at: float | None = None


_UNREADABLE = Delivery("failed", last_error="RECORD_UNREADABLE")


def _state_key(job_id: str, place: int) -> str:
    return f"{PREFIX}webhook:{job_id}:{place}"


@dataclass(frozen=True)
class Message:
    """A message about the end of an attempt. place: of its receiver among the job's webhooks."""

    job_id: str
    attempt: int
    place: int

    @classmethod
    def named(cls, name: str) -> Message:
        """The message of this name."""
        job_id, attempt, place = name.rsplit("-", 2)
        return cls(job_id, int(attempt), int(place))

    @property
    def name(self) -> str:
        return f"{self.job_id}-{self.attempt}-{self.place}"


def entering(before: JobRecord | None, after: JobRecord, expires: float) -> list[Command]:
    """What enters the messages about a job that has finished: about its end, or for webhooks added since."""
    known = before is not None and before.finished is not None and before.attempt == after.attempt
    first = len(before.webhooks) if before is not None and known else 0
    commands: list[Command] = []
    for place in range(first, len(after.webhooks)):
        key, message = _state_key(after.id, place), Message(after.id, after.attempt, place).name
        commands += [
            ("ZADD", _DUE, repr(after.finished), message),
            ("DEL", key),
            ("HSET", key, "message", message, "state", "pending", "sends", "0"),
            ("PEXPIREAT", key, str(int(expires * 1000))),
        ]
    return commands


def forgetting(record: JobRecord) -> list[Command]:
    """What drops the messages of a job that is deleted or started anew."""
    commands: list[Command] = []
    for place in range(len(record.webhooks)):
        message = Message(record.id, record.attempt, place).name
        commands += [("ZREM", _DUE, message), ("DEL", _state_key(record.id, place))]
    return commands


class RedisOutbox:
    """Hands out messages that are due, each to one process at a time."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._claim = redis.register_script(_CLAIM)
        self._settle = redis.register_script(_SETTLE)

    def claim(self) -> Message | None:
        """A message that is due, for this process alone for a minute; None when there is none."""
        while True:
            name: Any = self._claim(keys=[_DUE], args=[_LEASE_S])
            if name is None:
                return None
            try:
                return Message.named(text(name))
            except ValueError:
                self._redis.zrem(_DUE, name)
                count(self._redis, "records_unreadable", "webhook")
                logger.error("a message about a job has a name that cannot be read: it is dropped")

    def settle(self, message: Message, delivery: Delivery, outcome: str = "dropped") -> None:
        """Write down how a send went: put the message off until ``next_at``, or be done with it."""
        shown: dict[str, Any] = {"state": delivery.state, "sends": delivery.sends}
        for name in ("last_status", "last_error", "next_at", "delivered_at"):
            value = getattr(delivery, name)
            shown[name] = "" if value is None else value
        due = "" if delivery.next_at is None else repr(delivery.next_at)
        fields = [part for pair in shown.items() for part in pair]
        key = _state_key(message.job_id, message.place)
        self._settle(keys=[_DUE, key], args=[due, message.name, *fields])
        count(self._redis, "webhook_sends", outcome)

    def deliveries(self, record: JobRecord) -> list[Delivery]:
        """The state of the message to each of the job's webhooks."""
        if not record.webhooks:
            return []
        with self._redis.pipeline(transaction=False) as pipeline:
            for place in range(len(record.webhooks)):
                pipeline.hgetall(_state_key(record.id, place))
            return [_delivery(held) for held in pipeline.execute(raise_on_error=False)]

    def waiting(self) -> int:
        """How many messages are still to be sent."""
        return int(self._redis.zcard(_DUE))


def _delivery(answer: Any) -> Delivery:
    """The state that Redis holds of a message; members that are not known say nothing."""
    if is_wrong_type(answer):
        return _UNREADABLE
    if isinstance(answer, Exception):
        raise answer
    found = {text(name): text(value) for name, value in answer.items()}
    if not found:
        return Delivery()
    try:
        made = Delivery(
            state=cast(DeliveryState, found["state"]),
            sends=int(found["sends"]),
            last_status=int(found["last_status"]) if found.get("last_status") else None,
            last_error=found.get("last_error") or None,
            next_at=float(found["next_at"]) if found.get("next_at") else None,
            delivered_at=float(found["delivered_at"]) if found.get("delivered_at") else None,
        )
    except (KeyError, ValueError):
        return _UNREADABLE
    times = (made.next_at or 0.0, made.delivered_at or 0.0)
    is_sound = made.state in get_args(DeliveryState) and all(0 <= time < LAST_TIME for time in times)
    return made if is_sound else _UNREADABLE

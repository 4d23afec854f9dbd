"""The messages that are still to be sent, in Redis: entered together with the end of a job, so that none is lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast

from redis import Redis

from regnf_state.records import JobRecord
from regnf_state.redis.counters import count
from regnf_state.redis.documents import PREFIX, Command, text

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
if redis.call('HGET', KEYS[2], 'message') == ARGV[2] then redis.call('HSET', KEYS[2], unpack(ARGV, 3)) end
"""


DeliveryState = Literal["waiting", "pending", "delivered", "failed"]


@dataclass(frozen=True)
class Delivery:
    """How the message about a job's end fares. Times are the store's, seconds since the epoch."""

    state: DeliveryState = "waiting"
    """waiting for the job's end; to be sent; received; given up."""
    sends: int = 0
    last_status: int | None = None
    last_error: str | None = None
    next_at: float | None = None
    delivered_at: float | None = None


def _state_key(job_id: str) -> str:
    return f"{PREFIX}webhook:{job_id}"


def message_of(record: JobRecord) -> str:
    """The name of the message about the end of this attempt."""
    return f"{record.id}-{record.attempt}"


def entering(record: JobRecord, expires: float) -> list[Command]:
    """What enters the message about a job that has just finished."""
    if "webhook" not in record.request:
        return []
    key, message = _state_key(record.id), message_of(record)
    return [
        ("ZADD", _DUE, repr(record.finished), message),
        ("DEL", key),
        ("HSET", key, "message", message, "state", "pending", "sends", "0"),
        ("PEXPIREAT", key, str(int(expires * 1000))),
    ]


def forgetting(record: JobRecord) -> list[Command]:
    """What drops the message of a job that is deleted or started anew."""
    if "webhook" not in record.request:
        return []
    return [("ZREM", _DUE, message_of(record)), ("DEL", _state_key(record.id))]


class RedisOutbox:
    """Hands out messages that are due, each to one process at a time."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._claim = redis.register_script(_CLAIM)
        self._settle = redis.register_script(_SETTLE)

    def claim(self) -> str | None:
        """A message that is due, for this process alone for a minute; None when there is none."""
        message: Any = self._claim(keys=[_DUE], args=[_LEASE_S])
        return None if message is None else text(message)

    def settle(self, message: str, delivery: Delivery, outcome: str = "dropped") -> None:
        """Write down how a send went: put the message off until ``next_at``, or be done with it."""
        job_id = message.rpartition("-")[0]
        shown: dict[str, Any] = {"state": delivery.state, "sends": delivery.sends}
        for name in ("last_status", "last_error", "next_at", "delivered_at"):
            value = getattr(delivery, name)
            shown[name] = "" if value is None else value
        due = "" if delivery.next_at is None else repr(delivery.next_at)
        fields = [part for pair in shown.items() for part in pair]
        self._settle(keys=[_DUE, _state_key(job_id)], args=[due, message, *fields])
        count(self._redis, "webhook_sends", outcome)

    def delivery(self, job_id: str) -> Delivery:
        held: Any = self._redis.hgetall(_state_key(job_id))
        found = {text(name): text(value) for name, value in held.items()}
        if not found:
            return Delivery()
        return Delivery(
            state=cast(DeliveryState, found["state"]),
            sends=int(found["sends"]),
            last_status=int(found["last_status"]) if found.get("last_status") else None,
            last_error=found.get("last_error") or None,
            next_at=float(found["next_at"]) if found.get("next_at") else None,
            delivered_at=float(found["delivered_at"]) if found.get("delivered_at") else None,
        )

    def waiting(self) -> int:
        """How many messages are still to be sent."""
        return int(self._redis.zcard(_DUE))

"""The messages that are still to be sent, in Redis: entered together with the end of a job, so that none is lost.

A job has a message for each of its webhooks, named by the job, its attempt and the webhook's place among them. The
messages of a caller to one receiver wait in a line of their own, and the lines take turns.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError
from redis import Redis

from regnf_state.records import LAST_TIME, JobRecord
from regnf_state.redis.counters import count
from regnf_state.redis.documents import Command, text, unless_wrong_type
from regnf_state.redis.unreadable import PREFIX

logger = logging.getLogger(__name__)
_LINES = f"{PREFIX}webhooks:lines"
"""The lines that may have messages, by when each had its turn last."""
_LEASE_S = 60
"""A message that was taken and neither delivered nor put off for so long was taken by a process that died."""
_CLAIM = """
local time = redis.call('TIME')
local now = time[1] + time[2] / 1e6
local passed_over = {}
for i = 3, #ARGV do passed_over[ARGV[i]] = true end
for _, line in ipairs(redis.call('ZRANGE', KEYS[1], 0, -1)) do
  if not passed_over[line] and not passed_over[string.match(line, '^[^ ]*')] then
    local key = ARGV[2] .. line
    local due = redis.call('ZRANGEBYSCORE', key, '-inf', now, 'LIMIT', 0, 1)
    if due[1] then
      redis.call('ZADD', key, now + ARGV[1], due[1])
      redis.call('ZADD', KEYS[1], now, line)
      return {line, due[1]}
    end
    if redis.call('EXISTS', key) == 0 then redis.call('ZREM', KEYS[1], line) end
  end
end
return false
"""
_SETTLE = """
if ARGV[1] == '' then redis.call('ZREM', KEYS[1], ARGV[2]) else redis.call('ZADD', KEYS[1], 'XX', ARGV[1], ARGV[2]) end
if redis.pcall('HGET', KEYS[2], 'message') == ARGV[2] then redis.call('HSET', KEYS[2], 'delivery', ARGV[3]) end
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


_DELIVERY = TypeAdapter(Delivery)
_UNREADABLE = Delivery("failed", last_error="RECORD_UNREADABLE")


def due_key(line: str) -> str:
    """Where the messages of a line wait, by when each is due."""
    return f"{PREFIX}webhooks:due:{line}"


def line_of(caller: str, url: str) -> str:
    """The line that a message waits in: a caller's messages to one receiver. The lines take turns."""
    return f"{caller} {re.split('[/?#]', url.partition('://')[2], maxsplit=1)[0].lower()}"


def _state_key(job_id: str, place: int) -> str:
    return f"{PREFIX}webhook:{job_id}:{place}"


@dataclass(frozen=True)
class Message:
    """A message about the end of an attempt. place: of its receiver among the job's webhooks · line: as ``line_of``."""

    job_id: str
    attempt: int
    place: int
    line: str

    @classmethod
    def named(cls, name: str, line: str) -> Message:
        job_id, attempt, place = name.rsplit("-", 2)
        return cls(job_id, int(attempt), int(place), line)

    @classmethod
    def about(cls, record: JobRecord, place: int) -> Message:
        """The message about the record's end to one of its receivers."""
        return cls(record.id, record.attempt, place, line_of(record.owner, record.webhooks[place]))

    @property
    def caller(self) -> str:
        """Whose job it is."""
        return self.line.partition(" ")[0]

    @property
    def name(self) -> str:
        return f"{self.job_id}-{self.attempt}-{self.place}"


def entering(before: JobRecord | None, after: JobRecord, expires: float) -> list[Command]:
    """What enters the messages about a job that has finished: about its end, or for webhooks added since."""
    known = before is not None and before.finished is not None and before.attempt == after.attempt
    first = len(before.webhooks) if before is not None and known else 0
    commands: list[Command] = []
    for place in range(first, len(after.webhooks)):
        key, message = _state_key(after.id, place), Message.about(after, place)
        commands += [
            ("ZADD", due_key(message.line), repr(after.finished), message.name),
            ("ZADD", _LINES, "NX", "0", message.line),
            ("DEL", key),
            ("HSET", key, "message", message.name),
            ("PEXPIREAT", key, str(int(expires * 1000))),
        ]
    return commands


def forgetting(record: JobRecord) -> list[Command]:
    """What drops the messages of a job that is deleted or started again."""
    commands: list[Command] = []
    for place in range(len(record.webhooks)):
        message = Message.about(record, place)
        commands += [("ZREM", due_key(message.line), message.name), ("DEL", _state_key(record.id, place))]
    return commands


class RedisOutbox:
    """Hands out messages that are due, each to one process at a time."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._claim = redis.register_script(_CLAIM)
        self._settle = redis.register_script(_SETTLE)

    def claim(self, passed_over: Collection[str] = ()) -> Message | None:
        """A message that is due, for this process alone for a minute; None when there is none.

        Of the line that has waited longest for its turn. passed_over: lines, and callers, that do not get one.
        """
        while True:
            found: Any = self._claim(keys=[_LINES], args=[_LEASE_S, due_key(""), *passed_over])
            if found is None:
                return None
            line, name = map(text, found)
            try:
                return Message.named(name, line)
            except ValueError:
                self._redis.zrem(due_key(line), name)
                count(self._redis, "records_unreadable", "webhook")
                logger.error("a message about a job has an unreadable name: it is dropped")

    def settle(self, message: Message, delivery: Delivery, outcome: str = "dropped") -> None:
        """Write down how a send went: put the message off until ``next_at``, or be done with it."""
        due = "" if delivery.next_at is None else repr(delivery.next_at)
        keys = [due_key(message.line), _state_key(message.job_id, message.place)]
        self._settle(keys=keys, args=[due, message.name, _DELIVERY.dump_json(delivery)])
        count(self._redis, "webhook_sends", outcome)

    def deliveries(self, record: JobRecord) -> list[Delivery]:
        """The state of the message to each of the job's webhooks."""
        if not record.webhooks:
            return []
        with self._redis.pipeline(transaction=False) as pipeline:
            for place in range(len(record.webhooks)):
                pipeline.hmget(_state_key(record.id, place), "message", "delivery")
            return [_delivery(held) for held in pipeline.execute(raise_on_error=False)]

    def waiting(self) -> int:
        """How many messages are still to be sent."""
        lines: Any = self._redis.zrange(_LINES, 0, -1)
        return sum(int(self._redis.zcard(due_key(text(line)))) for line in lines)


def _delivery(answer: Any) -> Delivery:
    message, told = unless_wrong_type(answer, (None, "damaged"))
    if told is None:
        return Delivery("waiting" if message is None else "pending")
    try:
        made = _DELIVERY.validate_json(told)
    except ValidationError:
        return _UNREADABLE
    times = (made.next_at or 0.0, made.delivered_at or 0.0)
    return made if all(0 <= time < LAST_TIME for time in times) else _UNREADABLE

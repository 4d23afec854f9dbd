"""Which batches there are, and where each one is: an index in Redis over what the storage holds, made anew from it.

Keys:  regnf:batches:open              set of {owner}/{id}         regnf:batches:ended   sorted by the time of the end
       regnf:batches:created:{owner}   sorted by time of creation  regnf:batches:read    the run of the server that
       regnf:batch:{owner}/{id}        hash: block, state                                knows all
       regnf:batch:{owner}/{id}:gone   tombstone
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.batch_records import Batch, BatchName, BatchState, read_state, state_text
from regnf_state.pages import Position
from regnf_state.records import UnreadableRecordError
from regnf_state.redis.documents import text
from regnf_state.redis.keys import PREFIX

_OPEN = f"{PREFIX}batches:open"
_ENDED = f"{PREFIX}batches:ended"
_READ = f"{PREFIX}batches:read"
_CREATED = f"{PREFIX}batches:created:"
_ONE = f"{PREFIX}batch:"
_PAGE = 100
_NOTE = """
local held = tonumber(redis.call('HGET', KEYS[1], 'block') or '-1')
if held > tonumber(ARGV[1]) then return 0 end
redis.call('HSET', KEYS[1], 'block', ARGV[1], 'state', ARGV[2])
return 1
"""
_Value = TypeVar("_Value")


class BatchIndex:
    """The index in one Redis. What is damaged in it is dropped whole: the next look makes it anew from the storage."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._note = redis.register_script(_NOTE)

    def is_current(self) -> bool:
        """Whether all batches of the storage are in it: not after Redis was emptied or restarted."""
        held: Any = self._mended(lambda: self._redis.get(_READ))
        return held is not None and text(held) == self._run()

    def mark_current(self) -> None:
        self._redis.set(_READ, self._run())

    def _run(self) -> str:
        server: Any = self._redis.info("server")
        return str(server.get("run_id", ""))

    def enter(self, batch: Batch, state: BatchState) -> None:
        """List a batch, as it is."""
        self._mended(lambda: self._redis.zadd(f"{_CREATED}{batch.owner}", {batch.id: batch.created}))
        self.note(batch.name, state)

    def note(self, name: BatchName, state: BatchState) -> bool:
        """Keep where a batch is, unless a later block is known; whether it was kept."""
        member = _member(name)

        def keep() -> bool:
            if not self._note(keys=[_ONE + member], args=[state.block, state_text(state)]):
                return False
            if state.status == "running":
                self._redis.sadd(_OPEN, member)
                self._redis.zrem(_ENDED, member)
            else:
                self._redis.zadd(_ENDED, {member: state.finished or state.updated})
                self._redis.srem(_OPEN, member)
            return True

        return self._mended(keep)

    def state(self, name: BatchName) -> BatchState | None:
        """Where a batch was when that was noted last; None where that is not known."""
        held: Any = self._mended(lambda: self._redis.hget(_ONE + _member(name), "state"))
        if held is None:
            return None
        try:
            return read_state(name.id, held)
        except UnreadableRecordError:
            self.forget_state(name)
            return None

    def forget_state(self, name: BatchName) -> None:
        """So that the next look reads it from the storage."""
        self._redis.delete(_ONE + _member(name))

    def open(self) -> list[BatchName]:
        """The batches that go on."""
        held: Any = self._mended(lambda: self._redis.smembers(_OPEN))
        return sorted(map(_name, held))

    def count(self, owner: str) -> int:
        return int(self._mended(lambda: self._redis.zcard(f"{_CREATED}{owner}")))

    def newest_first(self, owner: str, before: Position | None) -> Iterator[Position]:
        """(time of creation, id) of an owner's batches, older than ``before``."""
        found: Any = self._mended(lambda: self._redis.zrevrange(f"{_CREATED}{owner}", 0, -1, withscores=True))
        positions = [(float(score), text(name)) for name, score in found]
        return (one for one in positions if before is None or one < before)

    def ended_before(self, moment: float) -> list[BatchName]:
        held: Any = self._mended(lambda: self._redis.zrangebyscore(_ENDED, "-inf", moment))
        return list(map(_name, held))

    def oldest_ended(self, owner: str) -> BatchName | None:
        """The one of an owner's batches that has ended first."""
        held: Any = self._mended(lambda: self._redis.zrange(_ENDED, 0, -1))
        return next((name for name in map(_name, held) if name.owner == owner), None)

    def drop(self, name: BatchName, expired_s: int | None) -> None:
        """Forget a batch; ``expired_s``: for so long its owner is told that it has expired."""
        member = _member(name)
        self._redis.zrem(f"{_CREATED}{name.owner}", name.id)
        self._redis.srem(_OPEN, member)
        self._redis.zrem(_ENDED, member)
        self._redis.delete(_ONE + member, f"{_ONE}{member}:gone")
        if expired_s is not None:
            self._redis.set(f"{_ONE}{member}:gone", "1", ex=expired_s)

    def has_expired(self, name: BatchName) -> bool:
        return bool(self._redis.exists(f"{_ONE}{_member(name)}:gone"))

    def _mended(self, do: Callable[[], _Value]) -> _Value:
        try:
            return do()
        except ResponseError as error:
            if "WRONGTYPE" not in str(error):
                raise
        keys: list[Any] = [
            key
            for pattern in (f"{PREFIX}batches:*", f"{_ONE}*")
            for key in self._redis.scan_iter(pattern, count=1000)
            if not text(key).endswith(":gone")
        ]
        if keys:
            self._redis.delete(*keys)
        return do()


def _member(name: BatchName) -> str:
    return f"{name.owner}/{name.id}"


def _name(member: bytes | str) -> BatchName:
    owner, _, batch_id = text(member).partition("/")
    return BatchName(owner, batch_id)

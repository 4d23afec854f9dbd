"""The fair queue: callers take turns at the workers, over RQ's lists (docs/adr/0009-fair-queue.md).

A caller's waiting work is a line, first come first served; but jobs of batches stand behind all that was posted by
itself, and its imports. Callers with a line take turns, one piece of work each: who has had a turn goes behind all
others. One name lies in RQ's list, where the workers block; when a worker has taken it, the next call of any process
puts the next one there. So no call relies on the one before it: the death of a process costs nothing.

Keys, below the prefix:  line:{owner}   list of names        owners        sorted set: callers with a line, by turn
                         entry:{name}   hash, see below      turn          how many turns there have been
                         parked:{ref}   list of names        parkings      set: fields that something waits for
An entry: owner, kind, since, batch (of one); while it waits for a field: parked.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Work
from regnf_state.redis.documents import number, shown
from regnf_state.redis.unreadable import PREFIX

_PREFIX = f"{PREFIX}queue:"
LISTS = {f"rq:queue:{name}": name for name in (IMPORT_QUEUE_NAME, QUEUE_NAME)}
"""Where workers take from, and the queues of these lists."""
_NOT_DAMAGE = re.compile("OOM|MISCONF|READONLY|NOSCRIPT|BUSY|LOADING|NOPERM|MASTERDOWN|NOREPLICAS|denied")
"""What Redis says of a script that it does not run now, or not for us."""
# One call is one step, which Redis runs whole or not at all.
_SCRIPT = """
local P, op, name = KEYS[1], ARGV[1], ARGV[2]
local DAY = 86400
local LISTS = {import = 'rq:queue:regnf-import', registration = 'rq:queue:regnf'}
local time = redis.call('TIME')
local now = string.format('%.6f', time[1] + time[2] / 1e6)

local function entry_of(id) return P .. 'entry:' .. id end
local function line_of(owner) return P .. 'line:' .. owner end

-- what is no number, or none that turns can be, counts as if it were not there
local function turns()
  local found = tonumber(redis.call('GET', P .. 'turn') or '')
  return found and math.abs(found) < 1e12 and found or 0
end

-- who had no line stands before whoever had the last turn, and behind all others
local function join(owner, id, push, before)
  if before then
    redis.call('LINSERT', line_of(owner), 'BEFORE', before, id)
  else
    redis.call(push, line_of(owner), id)
  end
  redis.call('ZADD', P .. 'owners', 'NX', turns() - 0.5, owner)
end

-- the first job of a batch in the line: all before it was posted by itself, and is seldom much
local function first_of_batch(owner)
  for start = 0, redis.call('LLEN', line_of(owner)) - 1, 64 do
    for _, id in ipairs(redis.call('LRANGE', line_of(owner), start, start + 63)) do
      if redis.call('HEXISTS', entry_of(id), 'batch') == 1 then return id end
    end
  end
end

-- that a worker reports is told by what Redis lets expire: times in RQ's own lists are of the workers' clocks
local function runs(id)
  if redis.call('TYPE', 'rq:executions:' .. id).ok ~= 'zset' then return false end
  for _, one in ipairs(redis.call('ZRANGE', 'rq:executions:' .. id, 0, -1)) do
    if redis.call('EXISTS', 'rq:execution:' .. id .. ':' .. one) == 1 then return true end
  end
  return false
end

local function advance()
  while redis.call('LLEN', LISTS.import) + redis.call('LLEN', LISTS.registration) == 0 do
    local owner = redis.call('ZRANGE', P .. 'owners', 0, 0)[1]
    if not owner then return end
    local id, turn = redis.call('LPOP', line_of(owner)), turns() + 1
    redis.call('SET', P .. 'turn', turn)
    if redis.call('EXISTS', line_of(owner)) == 1 then
      redis.call('ZADD', P .. 'owners', turn, owner)
    else
      redis.call('ZREM', P .. 'owners', owner)
    end
    local kind = id and redis.call('HGET', entry_of(id), 'kind')
    if LISTS[kind] then
      redis.call('EXPIRE', entry_of(id), DAY)
      redis.call('RPUSH', LISTS[kind], id)
    end
  end
end

local function waits(id)
  local entry = redis.call('HMGET', entry_of(id), 'owner', 'parked')
  if entry[1] and redis.call('LPOS', line_of(entry[1]), id) then return true end
  if entry[2] and redis.call('LPOS', P .. 'parked:' .. entry[2], id) then return true end
  return redis.call('LPOS', LISTS.import, id) or redis.call('LPOS', LISTS.registration, id)
end

local function remove(id)
  local entry = redis.call('HMGET', entry_of(id), 'owner', 'parked')
  local found = redis.call('LREM', LISTS.import, 0, id) + redis.call('LREM', LISTS.registration, 0, id)
  if entry[1] then
    found = found + redis.call('LREM', line_of(entry[1]), 0, id)
    if redis.call('EXISTS', line_of(entry[1])) == 0 then redis.call('ZREM', P .. 'owners', entry[1]) end
  end
  if entry[2] then found = found + redis.call('LREM', P .. 'parked:' .. entry[2], 0, id) end
  redis.call('DEL', entry_of(id))
  return found
end

local steps = {}

-- what has been waiting already stays where it is; a leftover of a worker's death is replaced
function steps.enqueue(owner, kind, batch, ...)
  if waits(name) or runs(name) then return 0 end
  remove(name)
  redis.call('DEL', 'rq:job:' .. name)
  redis.call('HSET', 'rq:job:' .. name, ...)
  redis.call('HSET', entry_of(name), 'owner', owner, 'kind', kind, 'since', now)
  if batch == '1' then redis.call('HSET', entry_of(name), 'batch', 1) end
  join(owner, name, 'RPUSH', batch ~= '1' and first_of_batch(owner))
  return 1
end

function steps.turn() return 0 end

function steps.holds() return (waits(name) or runs(name)) and 1 or 0 end

function steps.remove()
  if remove(name) == 0 then return 0 end
  redis.call('DEL', 'rq:job:' .. name)
  return 1
end

-- taken, but it cannot run before the import of this field has ended
function steps.park(owner, kind, reference)
  redis.call('HSETNX', entry_of(name), 'since', now)
  redis.call('HSET', entry_of(name), 'owner', owner, 'kind', kind, 'parked', reference)
  redis.call('PERSIST', entry_of(name))
  redis.call('RPUSH', P .. 'parked:' .. reference, name)
  redis.call('SADD', P .. 'parkings', reference)
  return 1
end

-- ``name`` is the field; those who have waited longest come first
function steps.release()
  local parked = redis.call('LRANGE', P .. 'parked:' .. name, 0, -1)
  for index = #parked, 1, -1 do
    local owner = redis.call('HGET', entry_of(parked[index]), 'owner')
    if owner then
      redis.call('HDEL', entry_of(parked[index]), 'parked')
      join(owner, parked[index], 'LPUSH')
    end
  end
  redis.call('DEL', P .. 'parked:' .. name)
  redis.call('SREM', P .. 'parkings', name)
  return #parked
end

local answer = steps[op](unpack(ARGV, 3))
advance()
return answer
"""
_Value = TypeVar("_Value")
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Line:
    """What a caller has waiting, and for how long the first of it has waited."""

    owner: str
    waiting: int
    oldest_s: float


class Waiting(NamedTuple):
    """Work that is to wait, with what RQ holds of it. of_batch: whether it is of a batch."""

    work: Work
    owner: str
    payload: Mapping[str, Any]
    of_batch: bool = False


class FairQueue:
    """The waiting work of all callers."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._script = redis.register_script(_SCRIPT)

    def _step(self, step: str, name: str = "", *arguments: Any) -> int:
        """One step. Where the keys are damaged the queue begins again, and the reaper queues what waited."""
        return self._mended(lambda: int(self._run(self._redis, step, name, *arguments)))

    def _run(self, client: Redis, step: str, name: str, *arguments: Any) -> Any:
        return self._script(keys=[_PREFIX], args=[step, name, *arguments], client=client)

    def _mended(self, do: Callable[[], _Value]) -> _Value:
        """What ``do`` returns, on an empty queue if the keys of this one are damaged."""
        try:
            return do()
        except ResponseError as error:
            if not _tells_of_damage(error):
                raise
            logger.error("the fair queue is damaged and starts empty: %s", error)
        damaged = [key for key in LISTS if self._redis.type(key) != b"list"]
        held: list[Any] = [*self._redis.scan_iter(f"{_PREFIX}*", count=1000), *damaged]
        if held:
            self._redis.delete(*held)
        return do()

    def enqueue(self, *waiting: Waiting) -> list[bool]:
        """Put each at the end of its owner's line, or before the jobs of batches there; False for what waits or runs
        already."""
        return self._mended(lambda: self._enqueue(waiting)) if waiting else []

    def _enqueue(self, waiting: tuple[Waiting, ...]) -> list[bool]:
        with self._redis.pipeline(transaction=False) as pipeline:
            for work, owner, payload, of_batch in waiting:
                told = (part for pair in payload.items() for part in pair)
                self._run(pipeline, "enqueue", work.name, owner, work.kind, int(of_batch), *told)
            answers = pipeline.execute(raise_on_error=False)
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return [bool(answer) for answer in answers]

    def turn(self) -> None:
        """See to it that the next in turn lies where workers take from."""
        self._step("turn")

    def holds(self, name: str) -> bool:
        """Whether work waits, or is being run by a worker that still reports."""
        return bool(self._step("holds", name))

    def remove(self, name: str) -> bool:
        """Take waiting work out; False when it does not wait."""
        return bool(self._step("remove", name))

    def park(self, work: Work, owner: str, reference: str) -> None:
        """Have work that was taken wait for the import of a field."""
        self._step("park", work.name, owner, work.kind, reference)

    def release(self, reference: str) -> None:
        """Put what waited for this field, whose import has ended, at the front of its line."""
        self._step("release", reference)

    def awaited(self) -> list[str]:
        """The fields whose import something waits for."""
        return sorted(shown(field) for field in self._mended(lambda: self._redis.smembers(f"{_PREFIX}parkings")))

    def lines(self) -> list[Line]:
        """Every caller with work that waits, those whose turn is next first."""
        return self._mended(self._lines)

    def _lines(self) -> list[Line]:
        owners, ready, seconds = self._look()
        with self._redis.pipeline(transaction=False) as pipeline:
            for owner in owners:
                pipeline.lrange(f"{_PREFIX}line:{owner}", 0, 0)
                pipeline.llen(f"{_PREFIX}line:{owner}")
            answers = pipeline.execute()
            firsts = [shown(name) for name in (*ready, *(name for found in answers[::2] for name in found))]
            for name in firsts:
                pipeline.hmget(f"{_PREFIX}entry:{name}", "owner", "since")
            entries = [(shown(owner), number(since, seconds)) for owner, since in pipeline.execute() if owner]
        waiting = Counter(dict(zip(owners, answers[1::2], strict=True)))
        waiting.update(owner for owner, _ in entries[: len(ready)])
        oldest = dict(reversed(entries))
        waits = [(owner, count, seconds - oldest.get(owner, seconds)) for owner, count in waiting.items() if count]
        return [Line(owner, count, max(0.0, since)) for owner, count, since in waits]

    def _look(self) -> tuple[list[str], list[bytes], float]:
        with self._redis.pipeline() as pipeline:
            pipeline.zrange(f"{_PREFIX}owners", 0, -1)
            for key in LISTS:
                pipeline.lrange(key, 0, 0)
            pipeline.time()
            owners, imports, registrations, (seconds, _) = pipeline.execute()
        return [shown(owner) for owner in owners], imports + registrations, float(seconds)

    def position(self, work: Work) -> int | None:
        """The place of work in the order that is expected of what waits now; None when it is in no line."""
        return self._mended(lambda: self._position(work))

    def _position(self, work: Work) -> int | None:
        owners, ready, _ = self._look()
        if work.name.encode() in ready:
            return 1
        held: Any = self._redis.hget(f"{_PREFIX}entry:{work.name}", "owner")
        mine = shown(held or "")
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.lpos(f"{_PREFIX}line:{mine}", work.name)
            for owner in owners:
                pipeline.llen(f"{_PREFIX}line:{owner}")
            answers: list[int | None] = pipeline.execute()
        place, lengths = answers[0], [length or 0 for length in answers[1:]]
        if place is None or mine not in owners:
            return None
        own = owners.index(mine)
        before = [min(length, place + (turn < own)) for turn, length in enumerate(lengths) if turn != own]
        return 1 + place + len(ready) + sum(before)


def _tells_of_damage(error: ResponseError) -> bool:
    """Whether the script met a key of another type, or a value that it cannot reckon with: that stays until mended."""
    said = str(error)
    return ("WRONGTYPE" in said or "user_script" in said) and not _NOT_DAMAGE.search(said)

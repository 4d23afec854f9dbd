"""Documents in Redis that change by compare-and-set: the base of the record store."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar
from uuid import uuid4

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.record_store import LOOKED_AT, PAGE_BYTES, Page, Position
from regnf_state.records import FORMAT, FieldRecord, JobRecord, UnreadableRecordError, decoded, encoded
from regnf_state.redis.unreadable import MENDED, PREFIX, UNREADABLE, Stored, UnreadableRecords

_PAGE = 100
_PROBE_KEPT_S = 60
_MOST_S = 1e12
_Record = TypeVar("_Record", JobRecord, FieldRecord)
logger = logging.getLogger(__name__)

# A document is a hash of ``document`` (JSON), ``version``, ``format`` and ``token``; other members of the hash stay as
# they are. The token names the write that made it: when a connection breaks after the script ran and the client runs
# it again, the second run finds its own token. An index that is no index is set aside, and begun again: until then it
# holds nothing. COMPACT is no command of Redis: a stream has four kilobytes set apart with its first event, which are
# given back here.
_WRITE = (
    MENDED
    + """
local function size(command, key)
  local held = redis.pcall(command, key)
  if command ~= 'HVALS' then return type(held) == 'number' and held or 0 end
  local sum = 0
  for _, value in ipairs(held) do sum = sum + (tonumber(value) or 0) end
  return sum
end
local shape = redis.call('TYPE', KEYS[1]).ok
if shape ~= 'hash' and shape ~= 'none' then return 'CONFLICT' end
if redis.call('HGET', KEYS[1], 'token') == ARGV[1] then return 'OK' end
if (redis.call('HGET', KEYS[1], 'version') or '0') ~= ARGV[2] then return 'CONFLICT' end
for _, cap in ipairs(cjson.decode(ARGV[3])) do
  local held = 0
  for key in string.gmatch(cap[2], '%S+') do held = held + size(cap[1], key) end
  if held + cap[3] > cap[4] then return cap[5] end
end
for i = 4, #ARGV do
  local command = cjson.decode(ARGV[i])
  local done
  if command[1] == 'COMPACT' then
    local dumped = redis.pcall('DUMP', command[2])
    if type(dumped) == 'string' then redis.pcall('RESTORE', command[2], 0, dumped, 'REPLACE') end
  else
    done = mended(command)
  end
  if type(done) == 'table' and done.err then return done end
end
return 'OK'
"""
)

Command = tuple[str, ...]
Cap = tuple[str, str, int, int, str]
"""(SCARD, HLEN or HVALS for the sum of a hash's values, key, what is to be added, the most, the answer beyond it).

Of several keys with a space between them, the sum counts.
"""


@dataclass(frozen=True)
class Kind(Generic[_Record]):
    """Jobs, or fields: their name in keys, and what their documents are read as."""

    name: str
    record: type[_Record]

    def key(self, name: str) -> str:
        return f"{PREFIX}{self.name}:{name}"


class Change(NamedTuple):
    """One document's next version, with the commands around it: see ``_compare_and_set``."""

    key: str
    expected_version: int
    commands: Sequence[Command]
    record: JobRecord | FieldRecord | None = None
    caps: Sequence[Cap] = ()


class RedisDocuments:
    """Reads documents together with the server's clock, writes them together with their indexes, atomically."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._write = redis.register_script(_WRITE)
        self.unreadable = UnreadableRecords(redis)

    def now(self) -> float:
        """The Redis server's clock, seconds since the epoch."""
        seconds, microseconds = self._redis.time()
        return seconds + microseconds / 1e6

    def probe(self) -> None:
        """Returns when Redis takes a write. Raises RedisError."""
        self._redis.set(f"{PREFIX}probe", "1", ex=_PROBE_KEPT_S)

    # reading

    def _read(self, kind: Kind[_Record], name: str) -> tuple[_Record | None, float]:
        ((_, stored),), now = self._fetch_now(kind, [name])
        return self._record(kind, name, stored), now

    def _read_each(self, kind: Kind[_Record], names: Sequence[str]) -> list[_Record | None]:
        return [self._record(kind, name, stored) for name, stored in self._fetch_now(kind, names)[0]]

    def _read_many(self, kind: Kind[_Record], names: Sequence[str]) -> list[_Record]:
        found = (self._readable(kind, name, stored) for name, stored in self._fetch_now(kind, names)[0])
        return [record for record in found if record is not None]

    def _read_to_create(self, kind: Kind[_Record], name: str) -> tuple[_Record | None, float]:
        ((_, stored),), now = self._fetch_now(kind, [name])
        return self._before(kind, name, stored), now

    def _before(self, kind: Kind[_Record], name: str, stored: Stored | None) -> _Record | None:
        """What there is before a record is made: a damaged one does not stand in its way.

        Raises UnreadableRecordError for one of a later release.
        """
        try:
            return self._record(kind, name, stored)
        except UnreadableRecordError as error:
            if error.newer:
                raise
            return None

    def _fetch_now(self, kind: Kind[Any], names: Sequence[str]) -> tuple[list[tuple[str, Stored | None]], float]:
        with self._redis.pipeline(transaction=False) as pipeline:
            for name in names:
                ask(pipeline, kind.key(name))
            pipeline.time()
            *answers, moment = pipeline.execute(raise_on_error=False)
        if isinstance(moment, Exception):
            raise moment
        stored = [(name, stored_in(answer)) for name, answer in zip(names, answers, strict=True)]
        return stored, moment[0] + moment[1] / 1e6

    def _fetch_in_portions(self, kind: Kind[Any], names: Sequence[str]) -> Iterator[tuple[str, int, Stored | None]]:
        """The same a few at a time, as they are requested, with the bytes of each: at most PAGE_BYTES are held."""
        with self._redis.pipeline(transaction=False) as pipeline:
            for name in names:
                pipeline.hstrlen(kind.key(name), "document")
            sizes = [unless_wrong_type(answer, 0) for answer in pipeline.execute(raise_on_error=False)]
        begin = 0
        while begin < len(names):
            end, held = begin + 1, sizes[begin]
            while end < len(names) and held + sizes[end] <= PAGE_BYTES:
                held += sizes[end]
                end += 1
            for size, (name, stored) in zip(sizes[begin:end], self._fetch_now(kind, names[begin:end])[0], strict=True):
                yield name, size, stored
            begin = end

    def _page(
        self, index: str, kind: Kind[_Record], limit: int, before: Position | None, wanted: Callable[[_Record], bool]
    ) -> Page[_Record]:
        """The newest ``limit`` of the records in ``index`` that are ``wanted``, older than ``before``.

        Looks at LOOKED_AT records and PAGE_BYTES at most: the next page goes on after the last that was looked at.
        """
        found: list[_Record] = []
        last, left = before, PAGE_BYTES
        for looked_at, (position, size, record) in enumerate(self._newest_first(index, kind, before), 1):
            left -= size
            if left < 0 and looked_at > 1:
                return Page(found, last)
            if record is not None and wanted(record):
                if len(found) == limit:
                    return Page(found, last)
                found.append(record)
            last = position
            if looked_at == LOOKED_AT:
                return Page(found, last)
        return Page(found, None)

    def _newest_first(
        self, index: str, kind: Kind[_Record], before: Position | None
    ) -> Iterator[tuple[Position, int, _Record | None]]:
        """What the sorted set ``index`` lists by time of creation, older than ``before``: position, bytes, record.

        A record that is gone or cannot be read is None.
        """
        highest: float = before[0] if before is not None else math.inf
        seen_at_highest = 0
        while True:
            answer: Any = self._redis.zrevrangebyscore(index, highest, "-inf", seen_at_highest, _PAGE, withscores=True)
            page = [(float(score), text(name)) for name, score in answer]
            older = [position for position in page if before is None or position < before]
            for position, (name, size, stored) in zip(
                older, self._fetch_in_portions(kind, [name for _, name in older]), strict=True
            ):
                yield position, size, self._readable(kind, name, stored)
            if len(page) < _PAGE:
                return
            # continue from the last score, not by offset: records created in between would shift the offsets
            lowest = page[-1][0]
            seen_at_highest = sum(score == lowest for score, _ in page) + (seen_at_highest if lowest == highest else 0)
            highest = lowest

    # what cannot be read

    def _record(self, kind: Kind[_Record], name: str, stored: Stored | None) -> _Record | None:
        """What was read, decoded. What is damaged is set aside, and made again where that is possible.

        Raises UnreadableRecordError.
        """
        if stored is None:
            return None
        try:
            return _decoded(kind, name, stored)
        except UnreadableRecordError as error:
            self._heal(kind, name, stored, error)
            ((_, again),), _ = self._fetch_now(kind, [name])
            if again is None:
                raise
            return _decoded(kind, name, again)

    def _readable(self, kind: Kind[_Record], name: str, stored: Stored | None) -> _Record | None:
        """The same for lists and rounds, which go on without it."""
        try:
            return self._record(kind, name, stored)
        except UnreadableRecordError:
            return None
        except OSError as error:
            logger.warning("%s %s is skipped: %s", kind.name, name, type(error).__name__)
            return None

    def _heal(self, kind: Kind[Any], name: str, stored: Stored, error: UnreadableRecordError) -> None:
        self.unreadable.set_aside(kind.name, kind.key(name), stored, error)

    def _require_known(self, kind: Kind[Any], name: str) -> None:
        """Raises UnreadableRecordError for a record that is not there because it was set aside."""
        if self.unreadable.among([kind.key(name)]):
            raise UnreadableRecordError(name, "it was damaged")

    # writing

    def _compare_and_set(
        self,
        key: str,
        expected_version: int,
        commands: Iterable[Command],
        record: JobRecord | FieldRecord | None = None,
        caps: Sequence[Cap] = (),
    ) -> str:
        """Run ``commands`` and store ``record`` if the version is the expected one (0: no record).

        Returns OK, CONFLICT, or the answer of the first of ``caps`` that would be exceeded.
        """
        return text(
            self._write(keys=[key], args=_arguments(Change(key, expected_version, list(commands), record, caps)))
        )

    def _compare_and_set_each(self, changes: Sequence[Change]) -> list[str]:
        """The same for each, in one round trip: what one answers says nothing of the others."""
        if len(changes) == 1:
            return [self._compare_and_set(*changes[0])]
        with self._redis.pipeline(transaction=False) as pipeline:
            for change in changes:
                self._write(keys=[change.key], args=_arguments(change), client=pipeline)
            return [text(answer) for answer in pipeline.execute()]


def _arguments(change: Change) -> list[str | int]:
    token = uuid4().hex
    writes = list(change.commands)
    if (record := change.record) is not None:
        members = ("document", encoded(record), "version", str(record.version), "format", str(FORMAT))
        writes.insert(0, ("HSET", change.key, *members, "token", token))
    if change.expected_version == 0:
        writes.append(("ZREM", UNREADABLE, change.key))
    return [token, change.expected_version, json.dumps(change.caps), *(json.dumps(command) for command in writes)]


def owned_key(owner: str, what: str) -> str:
    """Where something is listed of one owner."""
    return f"{PREFIX}owner:{owner}:{what}"


def ask(pipeline: Any, key: str) -> None:
    """Ask for what is held of a record; ``stored_in`` reads the answer."""
    pipeline.hmget(key, "document", "version", "format")


def stored_in(answer: Any) -> Stored | None:
    """What was read under a key; None when there is nothing. Raises RedisError but for a key of another type."""
    held = unless_wrong_type(answer, None)
    if held is None:
        return Stored(is_hash=False)
    return None if held == [None, None, None] else Stored(True, *held)


def unless_wrong_type(answer: Any, otherwise: Any) -> Any:
    """An answer of a pipeline; ``otherwise`` where the key holds something else. Raises RedisError."""
    if is_wrong_type(answer):
        return otherwise
    if isinstance(answer, Exception):
        raise answer
    return answer


def is_wrong_type(answer: object) -> bool:
    """Whether a command was refused because its key holds something else."""
    return isinstance(answer, ResponseError) and "WRONGTYPE" in str(answer)


def _decoded(kind: Kind[_Record], name: str, stored: Stored) -> _Record:
    if stored.document is None or stored.version is None:
        raise UnreadableRecordError(name, "it is not a record")
    record = decoded(kind.record, name, stored.document, stored.format)
    if text(stored.version) != str(record.version):
        raise UnreadableRecordError(name, "its versions differ")  # no change could ever be written
    return record


def text(value: bytes | str) -> str:
    """What Redis answered, as text, whether or not the client decodes."""
    return value.decode() if isinstance(value, bytes) else value


def shown(value: bytes | str) -> str:
    """What Redis answered, as text, where it may be no text at all."""
    return value.decode(errors="backslashreplace") if isinstance(value, bytes) else value


def number(value: Any, otherwise: float = 0.0) -> float:
    """A number that Redis holds; ``otherwise`` for none, for what is no number, and for what no seconds can be."""
    try:
        found = float(value)
    except (TypeError, ValueError):
        return otherwise
    return found if abs(found) < _MOST_S else otherwise

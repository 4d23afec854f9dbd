"""Records that cannot be read: noted once, and set aside where they are damaged, so that everything else goes on.

What a later release has written stays where it is. Anything else is renamed to regnf:quarantine:{key} for a week. A
sorted set names both, by the time when they were found; there are at most a thousand.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.records import UnreadableRecordError

# What every key of the service begins with, whichever module it belongs to.

PREFIX = "regnf:"


# Lua that our scripts share: a command that goes on past what has been damaged in its key.

# A key of another type is set aside for a week, and begun again; so is a count that nothing can be added to. One script
# runs whole or not at all only as long as none of its commands fails: those before it are not undone.
MENDED = """
local function mended(command)
  local done = redis.pcall(unpack(command))
  local said = type(done) == 'table' and done.err
  if not said then return done end
  if string.find(said, 'WRONGTYPE') then
    redis.call('RENAME', command[2], 'regnf:quarantine:' .. command[2])
    redis.call('EXPIRE', 'regnf:quarantine:' .. command[2], 604800)
  elseif string.find(said, 'hash value') or string.find(said, 'overflow') or string.find(said, 'Infinity') then
    redis.call('HDEL', command[2], command[3])
  else
    return done
  end
  return redis.call(unpack(command))
end
"""


logger = logging.getLogger(__name__)
UNREADABLE = f"{PREFIX}unreadable"
QUARANTINE = f"{PREFIX}quarantine:"
KEPT_S = 7 * 24 * 3600
_MOST = 1000
# only what is still as it was read: another process may have put a good record in its place
_SET_ASIDE = (
    MENDED
    + """
local is_hash = redis.call('TYPE', KEYS[1]).ok == 'hash'
if is_hash ~= (ARGV[1] == 'hash') or redis.call('EXISTS', KEYS[1]) == 0 then return 0 end
if is_hash and (redis.call('HGET', KEYS[1], 'document') or '') ~= ARGV[2] then return 0 end
local now = redis.call('TIME')[1]
mended({'ZREMRANGEBYSCORE', KEYS[2], '-inf', now - ARGV[5]})
local first = redis.call('ZADD', KEYS[2], 'NX', now, KEYS[1])
if ARGV[3] == 'move' then
  redis.call('RENAME', KEYS[1], ARGV[4] .. KEYS[1])
  redis.call('EXPIRE', ARGV[4] .. KEYS[1], ARGV[5])
end
if first == 1 then mended({'HINCRBY', 'regnf:counters', 'records_unreadable|' .. ARGV[7], '1'}) end
while redis.call('ZCARD', KEYS[2]) > tonumber(ARGV[6]) do
  redis.call('DEL', ARGV[4] .. redis.call('ZPOPMIN', KEYS[2])[1])
end
return 1 + first
"""
)


@dataclass(frozen=True)
class Stored:
    """What a key holds of a record, as it is: a hash with these members, or something that is no hash."""

    is_hash: bool
    document: bytes | str | None = None
    version: bytes | str | None = None
    format: bytes | str | None = None


class UnreadableRecords:
    """The list of them in one Redis."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._set_aside = redis.register_script(_SET_ASIDE)

    def set_aside(self, kind: str, key: str, stored: Stored, error: UnreadableRecordError) -> bool:
        """Note it, and rename it if it is damaged. False when it is not there any more as it was read."""
        shape, document = ("hash" if stored.is_hash else "other"), stored.document or b""
        move = "stay" if error.newer else "move"
        answer: Any = self._set_aside(
            keys=[key, UNREADABLE], args=[shape, document, move, QUARANTINE, KEPT_S, _MOST, kind]
        )
        if answer == 2:
            where = "it stays where it is" if error.newer else f"it is kept as {QUARANTINE}{key} for a week"
            logger.error("%s; %s", error, where)
        return bool(answer)

    def among(self, keys: Sequence[str]) -> set[str]:
        """Under which of these keys is, or was, what is known to be unreadable."""
        scores = self._ask(lambda: self._redis.zmscore(UNREADABLE, list(keys))) if keys else None
        return {key for key, score in zip(keys, scores or (), strict=False) if score is not None}

    def total(self) -> int:
        return int(self._ask(lambda: self._redis.zcard(UNREADABLE)) or 0)

    @staticmethod
    def _ask(look: Callable[[], Any]) -> Any:
        """None where the list itself is none: the next record that is noted begins it again."""
        try:
            return look()
        except ResponseError as error:
            if "WRONGTYPE" not in str(error):
                raise
            return None

"""Documents in Redis that change by compare-and-set: the base of the record store."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any
from uuid import uuid4

from redis import Redis

PREFIX = "regnf:"
_PAGE = 100

# A document is a hash of ``document`` (JSON), ``version`` and ``token``. The token names the write that made it: when a
# connection breaks after the script ran and the client runs it again, the second run finds its own token.
_WRITE = """
if redis.call('HGET', KEYS[1], 'token') == ARGV[1] then return 'OK' end
if (redis.call('HGET', KEYS[1], 'version') or '0') ~= ARGV[2] then return 'CONFLICT' end
for _, cap in ipairs(cjson.decode(ARGV[3])) do
  local held = 0
  if cap[1] == 'HVALS' then
    for _, value in ipairs(redis.call('HVALS', cap[2])) do held = held + tonumber(value) end
  else
    held = redis.call(cap[1], cap[2])
  end
  if held + cap[3] > cap[4] then return cap[5] end
end
for i = 4, #ARGV do redis.call(unpack(cjson.decode(ARGV[i]))) end
return 'OK'
"""

Command = tuple[str, ...]
Cap = tuple[str, str, int, int, str]
"""(SCARD, HLEN or HVALS for the sum of a hash's values, key, what is to be added, the most, the answer beyond it)."""


class RedisDocuments:
    """Reads documents together with the server's clock, writes them together with their indexes, atomically."""

    def __init__(self, redis: Redis) -> None:
        self._redis = redis
        self._write = redis.register_script(_WRITE)

    def now(self) -> float:
        seconds, microseconds = self._redis.time()
        return seconds + microseconds / 1e6

    def ping(self) -> bool:
        return bool(self._redis.ping())

    def _read(self, key: str) -> tuple[dict[str, Any] | None, float]:
        """The document, if there is one, and the time of reading."""
        with self._redis.pipeline(transaction=False) as pipeline:
            pipeline.hget(key, "document")
            pipeline.time()
            document, (seconds, microseconds) = pipeline.execute()
        return json.loads(document) if document is not None else None, seconds + microseconds / 1e6

    def _read_each(self, keys: Iterable[str]) -> list[dict[str, Any] | None]:
        """The document of each key, or None. One round trip."""
        with self._redis.pipeline(transaction=False) as pipeline:
            for key in keys:
                pipeline.hget(key, "document")
            return [None if document is None else json.loads(document) for document in pipeline.execute()]

    def _read_many(self, keys: Iterable[str]) -> list[dict[str, Any]]:
        """The documents that exist, in the order of their keys."""
        return [document for document in self._read_each(keys) if document is not None]

    def _newest_first(
        self, index: str, key_of: Callable[[str], str], before: tuple[float, str] | None
    ) -> Iterator[dict[str, Any]]:
        """Documents listed in the sorted set ``index`` by time of creation, older than ``before`` = (created, name)."""
        highest: float = before[0] if before is not None else math.inf
        seen_at_highest = 0
        while True:
            answer: Any = self._redis.zrevrangebyscore(index, highest, "-inf", seen_at_highest, _PAGE, withscores=True)
            page = [(float(score), text(name)) for name, score in answer]
            yield from self._read_many(key_of(name) for score, name in page if before is None or (score, name) < before)
            if len(page) < _PAGE:
                return
            # continue from the last score, not by offset: records created in between would shift the offsets
            lowest = page[-1][0]
            seen_at_highest = sum(score == lowest for score, _ in page) + (seen_at_highest if lowest == highest else 0)
            highest = lowest

    def _compare_and_set(
        self,
        key: str,
        expected_version: int,
        commands: Iterable[Command],
        document: dict[str, Any] | None = None,
        caps: Sequence[Cap] = (),
    ) -> str:
        """Run ``commands`` and store ``document`` if the version is the expected one (0: no document).

        Returns OK, CONFLICT, or the answer of the first of ``caps`` that would be exceeded.
        """
        token = uuid4().hex
        writes = list(commands)
        if document is not None:
            text = json.dumps(document, separators=(",", ":"))
            writes.insert(0, ("HSET", key, "document", text, "version", str(document["version"]), "token", token))
        arguments: list[str | int] = [
            token,
            expected_version,
            json.dumps(caps),
            *(json.dumps(command) for command in writes),
        ]
        answer: bytes | str = self._write(keys=[key], args=arguments)
        return answer.decode() if isinstance(answer, bytes) else answer


def text(value: bytes | str) -> str:
    """What Redis answered, as text, whether or not the client decodes."""
    return value.decode() if isinstance(value, bytes) else value

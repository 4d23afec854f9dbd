"""Whether Redis holds what the journal says: it does not after it was emptied, exchanged, or restarted.

A key in Redis names the blob store whose journal was read into it, and the run of the server: one that restarts may
have lost the last second of its history.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any
from uuid import uuid4

from redis import Redis

from regnf_state.journal.journal import Journal
from regnf_state.journal.storage_claim import GENERATION_KEY, claim_storage
from regnf_state.redis.documents import text

_MARK = "if redis.call('GET', KEYS[1]) == ARGV[1] then redis.call('SET', KEYS[1], ARGV[2]) return 1 end return 0"


class Generation:
    """The mark of one blob store in one Redis."""

    def __init__(self, redis: Redis, journal: Journal) -> None:
        self._redis = redis
        self._journal = journal
        self._mark = redis.register_script(_MARK)

    @cached_property
    def _storage_id(self) -> str:
        return self._journal.storage_id()

    def _name(self) -> str:
        server: Any = self._redis.info("server")
        return f"{self._storage_id}:{server.get('run_id', '')}"

    def is_current(self) -> bool:
        """Whether everything in the journal is in Redis."""
        held: Any = self._redis.get(GENERATION_KEY)
        return held is not None and text(held) == self._name()

    def begin(self) -> str:
        """Note that the journal will be read now; returns the token for ``end``. Raises StorageMismatchError."""
        claim_storage(self._redis, self._storage_id)
        token = f"reading:{uuid4().hex}"
        self._redis.set(GENERATION_KEY, token)
        return token

    def end(self, token: str) -> bool:
        """Note that all of it is in Redis. False when Redis was emptied or another process began in between."""
        return bool(self._mark(keys=[GENERATION_KEY], args=[token, self._name()]))

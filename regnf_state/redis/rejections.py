"""Why an owner's uploads were rejected, kept after their fields are gone: the same bytes are not imported again for it.

Kept is what follows from the bytes, their description and the version of the gate. What a limit, a setting or the
machine had its part in (load, memory, storage, a worker's death) may end otherwise next time: it is never kept. Each
owner has rejections of its own. Those of others would tell it, by how soon the answer comes, what others have sent.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from regnf_core import __version__
from regnf_core.engine_revision import ENGINE_REVISION
from regnf_core.importing.gate.report import OF_THE_FILE
from regnf_state.records import FieldRecord
from regnf_state.redis.documents import RedisDocuments
from regnf_state.redis.keys import PREFIX

_KEPT_S = 24 * 3600
_MOST = 256
_PUT = """
redis.call('SET', KEYS[2], ARGV[1], 'EX', ARGV[2])
redis.call('ZADD', KEYS[1], ARGV[3], KEYS[2])
redis.call('EXPIRE', KEYS[1], ARGV[2])
for _, key in ipairs(redis.call('ZRANGE', KEYS[1], 0, -1 - tonumber(ARGV[4]))) do
  redis.call('DEL', key)
  redis.call('ZREM', KEYS[1], key)
end
"""


def _index(owner: str) -> str:
    return f"{PREFIX}owner:{owner}:rejections"


def _key(field: FieldRecord) -> str:
    asked = json.dumps([field.sha256, field.description, __version__, ENGINE_REVISION], sort_keys=True)
    return f"{PREFIX}rejection:{hashlib.sha256(asked.encode()).hexdigest()}"


class RedisRejections(RedisDocuments):
    """The part of the record store that is about rejections. Each owner's oldest go first."""

    def remember_rejection(self, field: FieldRecord, error: dict[str, Any]) -> None:
        """Keep why this upload was rejected, if that lies in the file."""
        if error.get("reason") not in OF_THE_FILE:
            return
        keys = [_index(field.owner), _key(field)]
        self._redis.eval(_PUT, 2, *keys, json.dumps(error), _KEPT_S, repr(self.now()), _MOST)

    def known_rejection(self, field: FieldRecord) -> dict[str, Any] | None:
        """Why the same upload was rejected lately."""
        held: Any = self._redis.get(_key(field))
        return None if held is None else json.loads(held)

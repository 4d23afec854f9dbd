"""One Redis belongs to one storage: two services over one Redis, with a storage each, would mix their jobs silently.

A storage has an id, made once and kept in it. Redis notes the id of the storage whose records it holds. A process whose
storage has another id refuses to start. A Redis that holds nothing yet, or that was emptied, takes the first id.
"""

from __future__ import annotations

import logging
from typing import Any

from redis import Redis

from regnf_state.redis.documents import text
from regnf_state.redis.keys import PREFIX

STORAGE_KEY = f"{PREFIX}storage"
GENERATION_KEY = f"{PREFIX}generation"
_READING = "reading"
logger = logging.getLogger(__name__)


class StorageMismatchError(RuntimeError):
    """The records in Redis are of another storage."""

    reason = "STORAGE_MISMATCH"


def claim_storage(redis: Redis, storage_id: str, adopt: str | None = None) -> None:
    """Note that this Redis belongs to the storage of this id. Raises StorageMismatchError, RedisError.

    ``adopt``: what the operator says: the id of the storage that shall have this Redis from now on.
    """
    known = _known(redis)
    if known is None:
        redis.set(STORAGE_KEY, storage_id, nx=True)
        known = _known(redis)
    if known == storage_id:
        if redis.get(STORAGE_KEY) is None:
            redis.set(STORAGE_KEY, storage_id, nx=True)
        return
    if adopt == storage_id:
        redis.set(STORAGE_KEY, storage_id)
        redis.delete(GENERATION_KEY)  # the journal of this storage is read now
        logger.warning("this Redis was of the storage %s; it is of the storage %s now", known, storage_id)
        return
    raise StorageMismatchError(
        f"this Redis holds the records of the storage {known}, and the storage here is {storage_id}. Check "
        "REGNF_REDIS_URL, REGNF_STORAGE_URL and REGNF_STATE_DIR: every process of a service needs the same. If this "
        f"storage shall have this Redis, start once with REGNF_ADOPT_STORAGE={storage_id}"
    )


def _known(redis: Redis) -> str | None:
    """Whose Redis it is. The release before noted it beside the run of the server whose journal was read."""
    noted: Any = redis.get(STORAGE_KEY)
    if noted is not None:
        return text(noted)
    generation: Any = redis.get(GENERATION_KEY)
    storage_id = "" if generation is None else text(generation).partition(":")[0]
    return storage_id if storage_id not in ("", _READING) else None

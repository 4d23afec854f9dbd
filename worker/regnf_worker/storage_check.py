"""Before a worker takes jobs: is its storage the one whose records Redis holds?"""

from __future__ import annotations

import os

from redis.exceptions import RedisError

from regnf_state.journal.storage_claim import StorageMismatchError, claim_storage
from regnf_state.settings import Settings
from regnf_state.stores import open_stores
from regnf_worker import kernel

_WAIT_S = 10.0


def check_storage(settings: Settings) -> None:
    """Raises StorageMismatchError. Says nothing while Redis or the storage is away: the front end looks again.

    In a process of its own: a client of an object store does not survive the forks to come.
    """
    reading, writing = os.pipe()

    def tell() -> None:
        os.write(writing, _mismatch(settings).encode())

    try:
        kernel.in_child(tell)
    finally:
        os.close(writing)
    with os.fdopen(reading, "rb") as told:
        message = told.read().decode()
    if message:
        raise StorageMismatchError(message)


def _mismatch(settings: Settings) -> str:
    """What is wrong; "" when nothing is, or nobody can tell."""
    stores = open_stores(settings, retries=0, storage_wait_s=_WAIT_S)
    try:
        claim_storage(stores.redis, stores.records.journal.storage_id(), settings.adopt_storage or None)
    except StorageMismatchError as error:
        return str(error)
    except (RedisError, OSError):
        pass
    return ""

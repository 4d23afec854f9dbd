"""Before `regnf serve` starts its processes: is its storage the one whose records Redis holds?"""

from __future__ import annotations

import logging

from redis.exceptions import RedisError

from regnf_cli.start_errors import StartError
from regnf_state.journal.storage_claim import StorageMismatchError, claim_storage
from regnf_state.settings import Settings
from regnf_state.stores import open_stores

_WAIT_S = 10.0
logger = logging.getLogger(__name__)


def check_storage(settings: Settings) -> None:
    """Raises StartError (STORAGE_MISMATCH). While Redis or the storage is away nobody can tell; the API looks again."""
    stores = open_stores(settings, retries=None, storage_wait_s=_WAIT_S)
    try:
        claim_storage(stores.redis, stores.records.journal.storage_id(), settings.adopt_storage or None)
    except StorageMismatchError as error:
        raise StartError(str(error), reason=error.reason) from error
    except (RedisError, OSError) as error:
        logger.warning("whose records Redis holds is looked up later: %s", type(error).__name__)
    finally:
        stores.redis.close()

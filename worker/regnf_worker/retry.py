"""Waiting for a Redis that is full, away or read-only."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import OutOfMemoryError, ReadOnlyError, RedisError
from redis.exceptions import TimeoutError as RedisTimeoutError
from rq.exceptions import StopRequested

_FIRST_WAIT_S = 0.1
MAX_WAIT_S = 2.0
_PASSING = (RedisConnectionError, RedisTimeoutError, OutOfMemoryError, ReadOnlyError)
_PASSING_WORDS = ("MISCONF ", "OOM ")
"""No class of their own: a disk that Redis cannot write to, and what older servers say of a script without memory."""
_Value = TypeVar("_Value")
logger = logging.getLogger(__name__)


def passes(error: RedisError) -> bool:
    """Whether the same command may succeed later. Waiting does not help with any other error."""
    return isinstance(error, _PASSING) or any(word in str(error) for word in _PASSING_WORDS)


def retry_until_available(what: str, do: Callable[[], _Value], stopped: Callable[[], bool] = lambda: False) -> _Value:
    """What ``do`` returns once Redis accepts it, however long that takes; ``do`` may be called several times.

    Raises StopRequested when ``stopped`` by then, and any error that does not pass.
    """
    wait_s = _FIRST_WAIT_S
    refusals = 0
    while True:
        try:
            value = do()
        except RedisError as error:
            if not passes(error):
                raise
            if stopped():
                raise StopRequested from error
            if not refusals:
                logger.warning("%s: Redis refuses, trying until it does not: %s", what, error)
            refusals += 1
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, MAX_WAIT_S)
        else:
            if refusals:
                logger.warning("%s: done after %d refusals", what, refusals)
            return value

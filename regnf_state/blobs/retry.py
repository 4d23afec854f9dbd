"""Waiting for a storage that is away for the moment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from regnf_state.blobs.base import StorageUnavailableError

LONGEST_WAIT_S = 2.0
_FIRST_WAIT_S = 0.1
_Value = TypeVar("_Value")


def until_available(do: Callable[[], _Value], patience_s: float) -> _Value:
    """What ``do`` returns, which bears being repeated. Raises StorageUnavailableError after ``patience_s`` seconds."""
    end = time.monotonic() + patience_s
    wait_s = _FIRST_WAIT_S
    while True:
        try:
            return do()
        except StorageUnavailableError:
            if time.monotonic() + wait_s > end:
                raise
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, LONGEST_WAIT_S)

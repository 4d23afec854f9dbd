"""Waiting for a storage that is away for the moment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from regnf_state.blobs.base import StorageUnavailableError

MAX_WAIT_S = 2.0
_FIRST_WAIT_S = 0.1
_Value = TypeVar("_Value")


def until_available(do: Callable[[], _Value], wait_s: float) -> _Value:
    """What ``do`` returns; it may be called several times. Raises StorageUnavailableError after ``wait_s`` seconds."""
    end = time.monotonic() + wait_s
    pause_s = _FIRST_WAIT_S
    while True:
        try:
            return do()
        except StorageUnavailableError:
            if time.monotonic() + pause_s > end:
                raise
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, MAX_WAIT_S)

"""Buckets of tokens in the memory of one process: how often each of many may do something."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable

_MOST = 4096


class Buckets:
    """A bucket of ``burst`` for each, which fills by ``per_s``. For one thread.

    No more than a few thousand are kept. Then the one goes that was asked longest ago: its next is full.
    """

    def __init__(self, per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = burst
        self._clock = clock
        self._held: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """What is left in the bucket, and when that was so; the one that was asked longest ago comes first."""

    def __len__(self) -> int:
        return len(self._held)

    def take(self, who: str) -> float:
        """Take one out: 0.0, or nothing was taken and these seconds pass until there is one."""
        now = self._clock()
        left, at = self._held.pop(who, (self._burst, now))
        left = min(self._burst, left + (now - at) * self._per_s)
        wait_s = 0.0 if left >= 1 else (1 - left) / self._per_s
        self._held[who] = (left if wait_s else left - 1, now)
        if len(self._held) > _MOST:
            self._held.popitem(last=False)
        return wait_s

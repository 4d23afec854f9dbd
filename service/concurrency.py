"""How many things of a kind a caller may have going on at once in this process."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from service.body import CLOSE
from service.problems import RETRY_LATER, Problem

_LOOK_EVERY_S = 0.02


class Slots:
    """At most ``most`` for each caller; ``reason`` is what a caller that has as many is told. For one thread."""

    def __init__(self, most: int, reason: str) -> None:
        self._most = most
        self._reason = reason
        self._taken: Counter[str] = Counter()

    def take(self, caller: str) -> None:
        """Take one; give it back with ``free``. Raises Problem."""
        if self._taken[caller] >= self._most:
            raise Problem(self._reason, headers=RETRY_LATER | CLOSE)
        self._taken[caller] += 1

    def free(self, caller: str) -> None:
        self._taken[caller] -= 1
        if not self._taken[caller]:
            del self._taken[caller]

    @contextmanager
    def held(self, caller: str) -> Iterator[None]:
        """One for as long as the context lasts. Raises Problem."""
        self.take(caller)
        try:
            yield
        finally:
            self.free(caller)

    async def emptied(self, seconds: float) -> None:
        """Wait until none is taken, at most this long."""
        deadline = time.monotonic() + seconds
        while self._taken and time.monotonic() < deadline:
            await asyncio.sleep(_LOOK_EVERY_S)

    @property
    def taken(self) -> int:
        """How many are taken by all callers together."""
        return self._taken.total()

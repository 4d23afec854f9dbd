"""How long records have been unchanged, by this process' monotonic clock, which no step of a clock affects."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


class Staleness:
    """Sees every record in every round. When two rounds are more than ``unbroken_s`` apart, all counting begins anew.

    A process that could not look, because Redis was away or the machine slept, does not know what changed. Where it
    knows that it could not, it says so with ``forget``.
    """

    def __init__(self, unbroken_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._unbroken_s = unbroken_s
        self._clock = clock
        self._now = clock()
        self._before: dict[str, tuple[Any, float]] = {}
        self._seen: dict[str, tuple[Any, float]] = {}

    def begin_round(self) -> None:
        """Look anew; what the round before did not see is forgotten."""
        now = self._clock()
        self._before = self._seen if now - self._now <= self._unbroken_s else {}
        self._now, self._seen = now, {}

    def forget(self) -> None:
        """Redis could not be written to: a record that stayed the same until now tells nothing."""
        self._before, self._seen = {}, {}

    def of(self, name: str, mark: Any) -> float:
        """For how many seconds the record ``name`` has been seen with this very mark."""
        known = self._before.get(name)
        since = known[1] if known is not None and known[0] == mark else self._now
        self._seen[name] = (mark, since)
        return self._now - since

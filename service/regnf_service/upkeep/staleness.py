"""How long records have stood still, by this process' own clock: no step of a clock and no outage fakes that."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any


class Staleness:
    """Told of every record in every round. When rounds were more than ``unbroken_s`` apart, everything begins anew.

    Whoever could not look, because Redis was away or the machine slept, does not know who was silent meanwhile.
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

    def of(self, name: str, mark: Any) -> float:
        """For how many seconds the record ``name`` has been seen with this very mark."""
        known = self._before.get(name)
        since = known[1] if known is not None and known[0] == mark else self._now
        self._seen[name] = (mark, since)
        return self._now - since

"""When something was killed or stood still: an end after repeated deaths is documented, one without them is a fault."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

BORNE = 1
"""Work whose process dies is run once more. If that dies too, it may have failed."""
_AFTER_SEVERAL = frozenset({"WORKER_LOST", "IMPORT_OUT_OF_MEMORY"})
"""What work may end as then. The gate does not know who has killed its process twice: docs/import-gate.md."""


class Deaths:
    """Every death with its begin and end. May be used from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._spans: list[tuple[str, float, float]] = []
        self._lock = threading.Lock()

    def during(self, name: str, deed: Callable[[], bool]) -> bool:
        """Do what may kill something, and note from when to when; what ``deed`` returns, which is whether it did."""
        under_way = (name, self._clock(), math.inf)
        with self._lock:
            self._spans.append(under_way)
        done = False
        try:
            done = deed()
        finally:
            with self._lock:
                self._spans.remove(under_way)
                if done:
                    self._spans.append((*under_way[:2], self._clock()))
        return done

    def since(self, moment: float) -> int:
        """How many that end work were under way at that time, or came later: jobs outlive the API."""
        with self._lock:
            return sum(end >= moment for name, _, end in self._spans if not name.startswith("API"))

    def excuse(self, reason: str, moment: float) -> bool:
        """Whether work that began then may have ended for this reason."""
        return reason in _AFTER_SEVERAL and self.since(moment) > BORNE

    def last_end(self, moment: float) -> float:
        """When the last one was over, if that was after ``moment``; now, while one is under way."""
        with self._lock:
            return min(self._clock(), max([moment, *(end for _, _, end in self._spans)]))

"""How long a child has run, without the time for which it was ready to run and others had the cores."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

LONGEST = 2.0
"""A child never has longer than so many times its limit, however much others do."""
_NANOSECONDS = 1e9


def waited_s(pid: int) -> float:
    """Seconds for which the process was ready and had no core, by Linux's account of its first thread; 0 without it."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / _NANOSECONDS
    except (OSError, ValueError, IndexError):
        return 0.0


@dataclass(frozen=True)
class FairClock:
    """Tells whether the process has had ``limit_s``. Where a machine has more to do than cores, that takes longer."""

    pid: int
    limit_s: float
    now: Callable[[], float] = time.monotonic
    waited: Callable[[int], float] = waited_s
    started: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "started", self.now())

    def left_s(self) -> float:
        """What is left of the limit, not below 0."""
        since = self.now() - self.started
        had = max(since - self.waited(self.pid), since / LONGEST)
        return max(0.0, self.limit_s - had)

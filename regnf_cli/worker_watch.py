"""Stop waiting for a service that has no worker."""

from __future__ import annotations

import time
from collections.abc import Callable

from regnf_core.errors import RegnfError

_LOOK_EVERY_S = 5.0


class NoWorkerError(RegnfError):
    """The service had no live worker for as long as the caller was ready to wait."""

    unavailable = True
    reason = "NO_WORKER"


class WorkerWatch:
    """Call ``look`` as often as you like while waiting for a job: it asks ``lives`` every few seconds."""

    def __init__(self, lives: Callable[[], bool], limit_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._lives = lives
        self._limit_s = limit_s
        self._clock = clock
        self._next_look = clock()
        self._missing_since: float | None = None

    def look(self) -> None:
        """Raises NoWorkerError once there has been no live worker for ``limit_s`` seconds."""
        now = self._clock()
        if now < self._next_look:
            return
        self._next_look = now + _LOOK_EVERY_S
        if self._lives():
            self._missing_since = None
            return
        if self._missing_since is None:
            self._missing_since = now
        if now - self._missing_since >= self._limit_s:
            raise NoWorkerError(
                f"the service has had no live worker for {self._limit_s:g} s",
                hint="Start one: `regnf worker`, or `regnf serve` with --workers 1. The job stays in the queue; the "
                "same command finds it again.",
            )
        self._next_look = min(self._next_look, self._missing_since + self._limit_s)

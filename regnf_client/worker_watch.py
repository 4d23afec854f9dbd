"""Stop waiting for a service that has no worker."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from regnf_client.errors import NoWorkerError
from regnf_client.patience import Patience
from regnf_client.steps import Flow, call

_LOOK_EVERY_S = 5.0


class WorkerWatch:
    """For how long a service has had no worker. While waiting, ask it whenever a look is ``due``, and say what you
    ``saw``."""

    def __init__(self, limit_s: float | None, clock: Callable[[], float] = time.monotonic) -> None:
        """limit_s: None waits for ever."""
        self._limit_s = limit_s
        self._clock = clock
        self._next_look = clock()
        self._missing_since: float | None = None

    @property
    def due(self) -> bool:
        """Whether to look again: every few seconds, and never without a limit."""
        return self._limit_s is not None and self._clock() >= self._next_look

    def saw(self, lives: bool) -> None:
        """Raises NoWorkerError once there has been no live worker for the limit, without a break."""
        now = self._clock()
        self._next_look = now + _LOOK_EVERY_S
        if lives or self._limit_s is None:
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


def look(watch: WorkerWatch, patience: Patience) -> Flow[None]:
    """Ask the service for its worker, if a look is due. Raises NoWorkerError."""
    if not watch.due:
        return
    # 503 is what a service without a worker answers, and no reason to ask again
    answer = yield from call(Patience(patience.total_s, retries=0), "GET", "/readyz")
    try:
        document = answer.json()
    except ValueError:
        document = None
    watch.saw(worker_lives(document))


def worker_lives(readiness: Any) -> bool:
    """Whether this answer of /readyz tells of a live worker; one that says nothing of it is taken to have one."""
    try:
        return readiness["checks"]["worker"] is not False
    except (KeyError, TypeError):
        return True

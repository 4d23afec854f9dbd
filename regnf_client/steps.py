"""What a client does, without saying how: flows are generators of steps, which a driver performs.

``Client`` performs them one after the other, ``AsyncClient`` awaits them; the flows are the same.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx

from regnf_client.answers import NoWorkerError, unreachable

# When a request is sent again, and after how long.

_PASSING = frozenset({"RATE_LIMITED", "TOO_MANY_REQUESTS_AT_ONCE", "ARTIFACT_NOT_READY"})
"""Refusals that time mends by itself. Quotas are told at once: they may last for hours."""
_PASSING_STATUSES = frozenset({409, 429})
_AWAY = frozenset({502, 503, 504})
_SPREAD = 2.0
"""So that many that were refused together do not ask together ever after."""


@dataclass(frozen=True)
class Patience:
    """total_s: the most seconds that the service's own `Retry-After` may cost one request · retries: how often it is
    sent again after a broken connection or a 502, 503, 504 · first_s: the pause before the first of these; each one is
    twice as long as the one before."""

    total_s: float = 120.0
    retries: int = 4
    first_s: float = 0.25

    def tries(self) -> Tries:
        """Of one request."""
        return Tries(self)


class Tries:
    """What is left of the patience for one request."""

    def __init__(self, patience: Patience) -> None:
        self._left_s = patience.total_s
        self._retries = patience.retries
        self._next_s = patience.first_s

    def wait_s(self, answer: httpx.Response | httpx.RequestError) -> float | None:
        """How long to wait before the same is asked again; None if that is of no use any more."""
        if isinstance(answer, httpx.Response):
            after = _retry_after_s(answer)
            if answer.status_code in _PASSING_STATUSES:
                return None if after is None or _reason(answer) not in _PASSING else self._spend(after)
            if answer.status_code not in _AWAY:
                return None
        else:
            after = None
            if not isinstance(answer, httpx.TransportError) or isinstance(answer, httpx.UnsupportedProtocol):
                return None
        if self._retries <= 0:
            return None
        self._retries -= 1
        wait_s, self._next_s = self._next_s, 2 * self._next_s
        return self._spend(max(wait_s / _SPREAD, after or 0.0))

    def _spend(self, seconds: float) -> float | None:
        wait_s = seconds * random.uniform(1.0, _SPREAD)  # noqa: S311
        if wait_s > self._left_s:
            return None
        self._left_s -= wait_s
        return wait_s


def _retry_after_s(answer: httpx.Response) -> float | None:
    text = answer.headers.get("retry-after", "")
    return float(text) if text.isascii() and text.isdecimal() else None


def _reason(answer: httpx.Response) -> str | None:
    try:
        problem = answer.json()
    except ValueError:
        return None
    return problem.get("reason") if isinstance(problem, dict) else None


_T = TypeVar("_T")


@dataclass(frozen=True)
class Call:
    """One request. The driver gives the answer, or the error of a connection. how: as ``httpx.Client.request``."""

    method: str
    path: str
    how: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Pause:
    """Wait for so many seconds."""

    seconds: float


@dataclass(frozen=True)
class Work:
    """Something that takes time and no network, such as reading a file. The driver gives what it returns."""

    do: Callable[[], Any]


@dataclass(frozen=True)
class Download:
    """The bytes of an address, appended to a file. The driver gives the answer, or the error of a connection."""

    path: str
    target: Path


Step = Call | Pause | Work | Download
Flow = Generator[Step, Any, _T]


def call(patience: Patience, method: str, path: str, **how: Any) -> Flow[httpx.Response]:
    """The answer to a request, which is sent again while that may help. Raises UnreachableError.

    Every request of the interface may be sent again: the same upload is the same field, the same request the same job.
    """
    return (yield from again(patience, Call(method, path, how)))


def again(patience: Patience, step: Call | Download) -> Flow[httpx.Response]:
    """The answer to a step that asks the service, done again while that may help. Raises UnreachableError."""
    tries = patience.tries()
    while True:
        answer: httpx.Response | httpx.RequestError = yield step
        wait_s = tries.wait_s(answer)
        if wait_s is not None:
            yield Pause(wait_s)
        elif isinstance(answer, httpx.RequestError):
            raise unreachable(answer) from answer
        else:
            return answer


def work(do: Callable[[], _T]) -> Flow[_T]:
    """What ``do`` returns, done where it keeps nobody waiting."""
    done: _T = yield Work(do)
    return done


# Stop waiting for a service that has no worker.

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

"""The operations of a client as flows: generators of steps that a driver performs.

``Client`` performs them one after the other, ``AsyncClient`` awaits them; the flows are the same.
"""

from __future__ import annotations

import math
import os
import random
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel

from regnf_client.answers import (
    NoWorkerError,
    WaitTimeoutError,
    checked,
    checked_address,
    checked_token,
    object_of,
    parsed,
    unreachable,
)

_T = TypeVar("_T")
_Model = TypeVar("_Model", bound=BaseModel)


@dataclass(frozen=True)
class Call:
    """One request. The driver returns the response, or the error of the connection. how: as
    ``httpx.Client.request``."""

    method: str
    path: str
    how: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Pause:
    """Wait for this number of seconds."""

    seconds: float


@dataclass(frozen=True)
class Work:
    """A step that takes time but no network, such as reading a file. The driver returns its return value."""

    do: Callable[[], Any]


@dataclass(frozen=True)
class Download:
    """The bytes of an address, appended to a file. The driver returns the response, or the error of the connection."""

    path: str
    target: Path

    def headers(self) -> dict[str, str]:
        """Headers of the request. The download continues after the bytes that the file already has."""
        held = self.target.stat().st_size if self.target.exists() else 0
        return {"Accept-Encoding": "identity"} | ({"Range": f"bytes={held}-"} if held else {})

    def mode(self, answer: httpx.Response) -> str:
        """The mode in which the file is opened for this response."""
        return "ab" if answer.status_code == httpx.codes.PARTIAL_CONTENT else "wb"


Step = Call | Pause | Work | Download
Flow = Generator[Step, Any, _T]


def work(do: Callable[[], _T]) -> Flow[_T]:
    """The return value of ``do``, run without blocking others."""
    done: _T = yield Work(do)
    return done


# When a request is sent again, and after how long.

_PASSING = frozenset({"RATE_LIMITED", "TOO_MANY_REQUESTS_AT_ONCE", "ARTIFACT_NOT_READY"})
"""Refusals that end by themselves. Quotas are reported immediately: they may last for hours."""
_PATIENCE_S = 120.0
"""The most that the service's own `Retry-After` may cost one request."""
_FIRST_PAUSE_S = 0.25
"""After a broken connection; each further pause is twice as long."""
_SPREAD = 2.0
"""So that many that were refused together do not ask together ever after."""


class Tries:
    """The remaining retries of one request. It is repeated ``retries`` times after a lost connection or a 502, 503 or
    504."""

    def __init__(self, retries: int) -> None:
        self._left_s = _PATIENCE_S
        self._retries = retries
        self._next_s = _FIRST_PAUSE_S

    def wait_s(self, answer: httpx.Response | httpx.RequestError) -> float | None:
        """How long to wait before the request is repeated; None if it must not be repeated."""
        after = None
        if isinstance(answer, httpx.Response):
            after = retry_after_s(answer)
            if answer.status_code in (409, 429):
                passing = after is not None and (object_of(answer) or {}).get("reason") in _PASSING
                return self._spend(after or 0.0) if passing else None
            if answer.status_code not in (502, 503, 504):
                return None
        elif not isinstance(answer, httpx.TransportError) or isinstance(answer, httpx.UnsupportedProtocol):
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


def retry_after_s(answer: httpx.Response) -> float | None:
    """The waiting time that the service requests."""
    text = answer.headers.get("retry-after", "")
    return float(text) if text.isascii() and text.isdecimal() else None


# Stop waiting: for a service that has no worker, and after the time that the caller gave.

_LOOK_EVERY_S = 5.0
_HOLD_S = 20


class WorkerWatch:
    """Measures how long a service has had no worker. While waiting, query the service when a query is ``due``, and pass
    the answer to ``saw``."""

    def __init__(self, limit_s: float | None, clock: Callable[[], float] = time.monotonic) -> None:
        """limit_s: None waits for ever."""
        self._limit_s = limit_s
        self._clock = clock
        self._next_look = clock()
        self._missing_since: float | None = None

    @property
    def due(self) -> bool:
        """Whether to query again: every few seconds, and never if there is no limit."""
        return self._limit_s is not None and self._clock() >= self._next_look

    def saw(self, lives: bool) -> None:
        """Raises NoWorkerError if there was no live worker for the whole time limit."""
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
                hint="Start one: `regnf worker`, or `regnf serve` with --workers 1. The job stays in the "
                "queue. Run the same command to follow it again.",
            )
        self._next_look = min(self._next_look, self._missing_since + self._limit_s)


class Deadline:
    """When a wait ends. None: never."""

    def __init__(self, timeout_s: float | None) -> None:
        self._timeout_s = timeout_s
        self._end = math.inf if timeout_s is None else time.monotonic() + timeout_s

    def hold_s(self) -> int:
        """How long the service may hold one response, seconds."""
        left_s = self._end - time.monotonic()
        return _HOLD_S if left_s >= _HOLD_S else max(0, math.ceil(left_s))

    def check(self, what: str) -> None:
        """Raises WaitTimeoutError after the deadline. what: the thing that is waited for."""
        if time.monotonic() >= self._end:
            hint = "It continues. The same call follows it again. Give a larger timeout_s, or None."
            raise WaitTimeoutError(f"{what} has not ended within {self._timeout_s:g} s", hint=hint)


# What both clients are made of.

ADDRESS = "http://127.0.0.1:8080"
WORKER_TIMEOUT_S = 60.0
_AROUND = "\ufeff \t\r\n"
"""What a shell keeps of a file that Windows wrote."""
_TIMEOUT = httpx.Timeout(60.0, connect=5.0)
Report = Callable[[str, float], None]
"""Called with a phase and its progress, 0..1."""


@dataclass(frozen=True)
class Asking:
    """The request behavior of one method call. timeout_s: longest wait; None: no limit."""

    retries: int
    watch: WorkerWatch
    report: Report | None = None
    timeout_s: float | None = None

    def tell(self, phase: str, share: float) -> None:
        """Report progress to the caller, if a callback is given."""
        if self.report is not None:
            self.report(phase, share)

    def deadline(self) -> Deadline:
        """The deadline of a wait that begins now."""
        return Deadline(self.timeout_s)

    def call(self, method: str, path: str, **how: Any) -> Flow[httpx.Response]:
        """The response to a request. The request is repeated while that may help. Raises UnreachableError.

        Every request of the interface may be sent again: the same upload is the same field, the same request the same
        job.
        """
        return self.again(Call(method, path, how))

    def again(self, step: Call | Download, retries: int | None = None) -> Flow[httpx.Response]:
        """The response to a step that queries the service. The step is repeated while that may help. Raises
        UnreachableError."""
        tries = Tries(self.retries if retries is None else retries)
        while True:
            answer: httpx.Response | httpx.RequestError = yield step
            wait_s = tries.wait_s(answer)
            if wait_s is not None:
                yield Pause(wait_s)
            elif isinstance(answer, httpx.RequestError):
                raise unreachable(answer) from answer
            else:
                return answer

    def document(self, model: type[_Model], method: str, path: str, **how: Any) -> Flow[_Model]:
        """The model of a successful response. Raises ServiceError too."""
        return parsed(model, checked((yield from self.call(method, path, **how))))

    def look(self) -> Flow[None]:
        """Ask the service for its worker, if a look is due. Raises NoWorkerError."""
        if self.watch.due:
            # 503 is what a service without a worker answers, and no reason to ask again
            answer = yield from self.again(Call("GET", "/readyz"), retries=0)
            checks = (object_of(answer) or {}).get("checks")
            # one that says nothing of its worker is taken to have one
            self.watch.saw(not (isinstance(checks, Mapping) and checks.get("worker") is False))


@dataclass(frozen=True)
class Connection:
    """Address, token and retry behavior of a client."""

    address: str
    token: str | None
    retries: int
    worker_timeout_s: float | None

    def http_options(self) -> dict[str, Any]:
        """Of httpx's clients. Raises InvalidInputError (INVALID_ADDRESS, INVALID_TOKEN)."""
        checked_address(self.address)
        token = self.token if self.token is not None else os.environ.get("REGNF_API_TOKEN")
        headers = {"Authorization": f"Bearer {checked_token(token.strip(_AROUND))}"} if token else {}
        return {"base_url": self.address.rstrip("/"), "headers": headers, "timeout": _TIMEOUT}

    def asking(self, report: Report | None = None, timeout_s: float | None = None) -> Asking:
        """For one call of a method."""
        return Asking(self.retries, WorkerWatch(self.worker_timeout_s), report, timeout_s)

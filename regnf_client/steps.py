"""What a client does, without saying how: flows are generators of steps, which a driver performs.

``Client`` performs them one after the other, ``AsyncClient`` awaits them; the flows are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import httpx

from regnf_client.errors import unreachable
from regnf_client.patience import Patience

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

"""How many things of a kind may go on at once in this process: of each caller, and of all together."""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

from anyio import CapacityLimiter, to_thread
from anyio.lowlevel import RunVar

from regnf_service.problem import CLOSE, RETRY_LATER, Problem

_LOOK_EVERY_S = 0.02
_STORE_THREADS = 40
_threads: RunVar[CapacityLimiter] = RunVar("store_threads")
_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def _store_threads() -> CapacityLimiter:
    """The threads for calls of stores. When all of them wait, what needs no store is still answered."""
    try:
        return _threads.get()
    except LookupError:
        _threads.set(CapacityLimiter(_STORE_THREADS))
        return _threads.get()


async def in_thread(work: Callable[..., _Result], *arguments: Any) -> _Result:
    """Run blocking work, a call of a store, in a thread."""
    return await to_thread.run_sync(work, *arguments, limiter=_store_threads())


def blocking(route: Callable[_Given, _Result]) -> Callable[_Given, Awaitable[_Result]]:
    """A route that calls stores, run in a thread of theirs. The framework would take one that everything shares."""

    @wraps(route)
    async def run(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        return await in_thread(partial(route, *args, **kwargs))

    return run


async def pause(seconds: float, stopping: asyncio.Event) -> bool:
    """Sleep, or less if the service stops. Returns whether it does."""
    try:
        async with asyncio.timeout(seconds):
            await stopping.wait()
    except TimeoutError:
        return False
    return True


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


class Waiters:
    """Answers that are held back. All of them together look for news ``looks_per_s`` times a second, however many.

    Each keeps a connection in use: beyond ``most``, or half as many of one caller, no further one is held back.
    """

    def __init__(self, looks_per_s: float = 200.0, most: int = 1000) -> None:
        self._looks_per_s = looks_per_s
        self._most = most
        self._held: Counter[str] = Counter()

    def has_room(self, caller: str) -> bool:
        """Whether one more answer to this caller may be held back."""
        return self._held.total() < self._most and 2 * self._held[caller] < self._most

    @contextmanager
    def held(self, caller: str) -> Iterator[None]:
        """One answer is held while the block runs."""
        self._held[caller] += 1
        try:
            yield
        finally:
            self._held[caller] -= 1
            if not self._held[caller]:
                del self._held[caller]

    def pause_s(self, wanted_s: float) -> float:
        """Seconds until one of them looks again: what it would like, or more where others look too.

        Up to a quarter more or less, so that those that began together do not look together ever after.
        """
        return max(wanted_s, self._held.total() / self._looks_per_s) * random.uniform(0.75, 1.25)  # noqa: S311

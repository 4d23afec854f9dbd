"""How many uploads a caller may have at once. One that is too slow loses its place when another asks for it."""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Protocol
from weakref import WeakValueDictionary

from regnf_service.problem import CLOSE, RETRY_LATER, Problem

_LOOK_EVERY_S = 0.02
_GRACE_S = 1.0
"""How far an upload may be behind the slowest pace before it loses its place: a few round trips of a bad line."""
_MOST_WAIT_S = 10.0
"""How long another waits for a place: until several hundred before it have each had theirs for that time."""


class Sender(Protocol):
    """Who sends an upload."""

    def behind_s(self) -> float:
        """By how much it is slower than it has to be; negative: faster."""
        ...

    def cut(self) -> None:
        """End its upload."""
        ...


class UploadSlots:
    """At most ``most`` for each caller. For one event loop."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._held: dict[str, list[Sender]] = {}
        self._lines: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._under_way: Counter[str] = Counter()

    @property
    def taken(self) -> int:
        """How many uploads of all callers are under way, those that lost their place and are being cleared up too."""
        return self._under_way.total()

    async def emptied(self, seconds: float) -> None:
        """Wait until none is under way, at most this long."""
        deadline = time.monotonic() + seconds
        while self.taken and time.monotonic() < deadline:
            await asyncio.sleep(_LOOK_EVERY_S)

    @asynccontextmanager
    async def held(self, caller: str, sender: Sender, count: int = 1) -> AsyncIterator[None]:
        """So many places for as long as the context lasts.

        Where all are taken, it waits its turn for a moment, unless all have been fast. Raises Problem TOO_MANY_UPLOADS.
        """
        await self._wait(caller, count)
        held = self._held.setdefault(caller, [])
        held += [sender] * count
        self._under_way[caller] += count
        try:
            yield
        finally:
            self._under_way[caller] -= count
            if not self._under_way[caller]:
                del self._under_way[caller]
            self._remove(caller, sender)

    async def _wait(self, caller: str, count: int) -> None:
        line = self._lines.setdefault(caller, asyncio.Lock())
        if not line.locked() and self._has_room(caller, count):
            return
        try:
            async with asyncio.timeout(_MOST_WAIT_S), line:
                while not self._has_room(caller, count):
                    await asyncio.sleep(_LOOK_EVERY_S)
        except TimeoutError as error:
            raise _refusal() from error

    def _has_room(self, caller: str, count: int) -> bool:
        """Whether there is room, if need be in place of the slowest. Raises Problem when none can become so slow."""
        while len(held := self._held.get(caller, [])) + count > self._most:
            slowest = max(held, key=lambda sender: sender.behind_s(), default=None)
            behind = -math.inf if slowest is None else slowest.behind_s()
            if slowest is None or behind + _MOST_WAIT_S < _GRACE_S:
                raise _refusal()
            if behind < _GRACE_S:
                return False
            slowest.cut()
            self._remove(caller, slowest)
        return True

    def _remove(self, caller: str, sender: Sender) -> None:
        held = [other for other in self._held.get(caller, []) if other is not sender]
        if held:
            self._held[caller] = held
        else:
            self._held.pop(caller, None)


class Assemblies:
    """Who may put an upload's pieces together: one of a caller at a time, ``most`` of all. For one event loop."""

    def __init__(self, most: int) -> None:
        self._all = asyncio.Semaphore(most)
        self._lines: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    @asynccontextmanager
    async def turn(self, caller: str) -> AsyncIterator[None]:
        """Waits for the caller's turn, which lasts as long as the context."""
        line = self._lines.setdefault(caller, asyncio.Lock())
        async with line, self._all:
            yield


def _refusal() -> Problem:
    return Problem("TOO_MANY_UPLOADS", headers=RETRY_LATER | CLOSE)

"""What every part of the service is given: settings, stores, and the limits that hold across requests."""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread
from redis import Redis

from regnf_service.concurrency import Slots, UnderWay, Waiters, pause
from regnf_service.problem import CLOSE, RETRY_LATER, Problem
from regnf_service.webhooks.targets import Webhooks
from regnf_state.batches import Batches
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.pieces import Pieces
from regnf_state.records import JobNews, Quota, quota_of
from regnf_state.redis.queue import JobQueue
from regnf_state.room import Originals, Room
from regnf_state.settings import Settings

# One look for all event streams of the process: in each round the store is asked once about every job they follow.

Position = tuple[str, str | None]
"""A job's id, and the last of its events that a stream has sent."""
_ROUND_S = 0.2


class JobWatch:
    """Streams ask it for news; it asks ``look`` (blocking) in a thread of its own, every 0.2 seconds while any asks."""

    def __init__(self, look: Callable[[Sequence[Position]], Sequence[JobNews]], stopping: asyncio.Event) -> None:
        self._look = look
        self._stopping = stopping
        self._limiter = CapacityLimiter(1)
        self._asked: dict[Position, list[asyncio.Future[JobNews]]] = {}
        self._next_round = 0.0
        self._rounds: asyncio.Task[None] | None = None

    async def news(self, job_id: str, after: str | None) -> JobNews:
        """The job, and its events after ``after``, as the next round finds them. Raises what ``look`` raises."""
        answer: asyncio.Future[JobNews] = asyncio.get_running_loop().create_future()
        self._asked.setdefault((job_id, after), []).append(answer)
        if self._rounds is None or self._rounds.done():
            self._rounds = asyncio.create_task(self._run())
        return await answer

    async def _run(self) -> None:
        """Rounds for as long as a stream asks."""
        while self._asked:
            await pause(self._next_round - time.monotonic(), self._stopping)
            asked, self._asked = self._asked, {}
            self._next_round = time.monotonic() + _ROUND_S
            # a stream that its client has left no longer waits for an answer
            waiting = {position: left for position, answers in asked.items() if (left := _open(answers))}
            if waiting:
                await self._answer(waiting)

    async def _answer(self, asked: dict[Position, list[asyncio.Future[JobNews]]]) -> None:
        try:
            found = await to_thread.run_sync(self._look, list(asked), limiter=self._limiter)
        except Exception as error:  # noqa: BLE001 -- every stream that asked raises it
            for answer in (answer for answers in asked.values() for answer in _open(answers)):
                answer.set_exception(error)
            return
        for answers, news in zip(asked.values(), found, strict=True):
            for answer in _open(answers):
                answer.set_result(news)


def _open(answers: list[asyncio.Future[JobNews]]) -> list[asyncio.Future[JobNews]]:
    return [answer for answer in answers if not answer.done()]


# How many uploads a caller may have at once. One that is too slow loses its place when another asks for it.

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


_ASSEMBLIES = 4
"""Each holds a copy of a whole upload for a moment."""


@dataclass(frozen=True)
class Services:
    """What every request may use. ``stopping`` is set when the process is to end: long answers then end too."""

    settings: Settings
    redis: Redis
    records: JournaledRecordStore
    blobs: BlobStore
    queue: JobQueue
    webhooks: Webhooks
    stopping: asyncio.Event = field(default_factory=asyncio.Event)
    waiters: Waiters = field(default_factory=Waiters)

    @cached_property
    def quota(self) -> Quota:
        """What each caller may have."""
        return quota_of(self.settings)

    @cached_property
    def room(self) -> Room:
        """Room for new records."""
        return Room(self.records, self.blobs, self.redis, self.settings)

    @cached_property
    def originals(self) -> Originals:
        """The uploads that stay after their import."""
        return Originals(self.records, self.blobs, self.settings)

    @cached_property
    def pieces(self) -> Pieces:
        """Uploads that come in pieces and are not finished."""
        return Pieces(self.blobs, self.settings)

    @cached_property
    def batches(self) -> Batches:
        """Batches of registrations."""
        return Batches(self.blobs)

    @cached_property
    def requests(self) -> Slots:
        """Requests that are in progress."""
        return Slots(self.settings.max_requests_per_caller, "TOO_MANY_REQUESTS_AT_ONCE")

    @cached_property
    def uploads(self) -> UploadSlots:
        """Uploads that are under way."""
        return UploadSlots(self.settings.max_uploads_per_caller)

    @cached_property
    def assembling(self) -> Assemblies:
        """Uploads whose pieces are being put together."""
        return Assemblies(_ASSEMBLIES)

    @cached_property
    def under_way(self) -> UnderWay:
        """The bytes of these uploads."""
        return UnderWay()

    @cached_property
    def streams(self) -> Slots:
        """Event streams that are being read."""
        return Slots(self.settings.max_streams_per_caller, "TOO_MANY_REQUESTS_AT_ONCE")

    @cached_property
    def job_watch(self) -> JobWatch:
        """What all event streams look through."""
        return JobWatch(self.records.news, self.stopping)

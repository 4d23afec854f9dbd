"""What every part of the service is given: settings, stores, and the limits that hold across requests."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread
from redis import Redis

from regnf_service.concurrency import Slots, UnderWay, Waiters, pause
from regnf_service.webhooks.targets import Webhooks
from regnf_state.batches import Batches
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import JournaledRecordStore
from regnf_state.pieces import Pieces
from regnf_state.records import JobNews, quota_of
from regnf_state.redis.queue import JobQueue
from regnf_state.room import Originals, Room
from regnf_state.settings import Settings

# One look for all event streams of the process: in each around the store is asked once about every job they follow.

Position = tuple[str, str | None]
"""A job's id, and the last of its events that a stream has sent."""
_ROUND_S = 0.2


class JobWatch:
    """Streams ask it for news; it asks ``look`` (blocking) in a thread of its own, every 0.2 seconds while any asks."""

    def __init__(self, look: Callable[[Sequence[Position]], Sequence[JobNews]], stopping: asyncio.Event) -> None:
        self._look = look
        self._stopping = stopping
        self._limiter = CapacityLimiter(1)
        self._asked: dict[Position, asyncio.Future[JobNews]] = {}
        self._next_round = 0.0
        self._rounds: asyncio.Task[None] | None = None

    async def news(self, job_id: str, after: str | None) -> JobNews:
        """The job, and its events after ``after``, as the next round finds them. Raises what ``look`` raises."""
        answer = self._asked.setdefault((job_id, after), asyncio.get_running_loop().create_future())
        if self._rounds is None or self._rounds.done():
            self._rounds = asyncio.create_task(self._run())
        return await asyncio.shield(answer)  # others may wait for the same

    async def _run(self) -> None:
        while self._asked:
            await pause(self._next_round - time.monotonic(), self._stopping)
            asked, self._asked = self._asked, {}
            self._next_round = time.monotonic() + _ROUND_S
            try:
                found = await to_thread.run_sync(self._look, list(asked), limiter=self._limiter)
            except Exception as error:  # noqa: BLE001 -- every stream that asked raises it
                for answer in asked.values():
                    answer.set_exception(error)
                    answer.exception()  # looked at, whether or not its streams are still there
                continue
            for answer, news in zip(asked.values(), found, strict=True):
                answer.set_result(news)


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


_ASSEMBLIES = 4
"""Each holds a copy of a whole upload for a moment."""


class Services:
    """What every request may use. ``stopping`` is set when the process is to end: long answers then end too."""

    def __init__(
        self,
        settings: Settings,
        redis: Redis,
        records: JournaledRecordStore,
        blobs: BlobStore,
        queue: JobQueue,
        webhooks: Webhooks,
    ) -> None:
        self.settings, self.redis, self.records = settings, redis, records
        self.blobs, self.queue, self.webhooks = blobs, queue, webhooks
        self.stopping = asyncio.Event()
        self.waiters = Waiters()
        self.quota = quota_of(settings)
        self.room = Room(records, blobs, redis, settings)
        self.originals = Originals(records, blobs, settings)
        self.pieces = Pieces(blobs, settings)
        self.batches = Batches(blobs)
        self.requests = Slots(settings.max_requests_per_caller, "requests")
        self.uploads = Slots(settings.max_uploads_per_caller, "uploads")
        self.streams = Slots(settings.max_streams_per_caller, "event streams")
        self.assembling = Assemblies(_ASSEMBLIES)
        self.under_way = UnderWay()
        self.job_watch = JobWatch(records.news, self.stopping)

"""One look for all event streams of the process: in each round the store is asked once about every job they follow."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from anyio import CapacityLimiter, to_thread

from regnf_service.concurrency import pause
from regnf_state.records import JobNews

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

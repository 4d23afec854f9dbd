"""All event streams of a process share their looks at the store."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

import pytest
from redis import Redis
from redis.exceptions import ConnectionError as RedisConnectionError

from regnf_service.http.sse import event_stream
from regnf_service.services import JobWatch, Position
from regnf_state.records import JobNews
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings
from tests.round_trips import counted_round_trips
from tests.state.record_makers import finished, started
from tests.stores import services_over


@pytest.mark.parametrize("streams", [1, 40])
def test_any_number_of_streams_is_one_round_trip_a_round(
    redis: Redis, tmp_path: Path, streams: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = services_over(redis, Settings(state_dir=tmp_path))
    store = services.records
    jobs = [finished(store, "failed", f"j{number}").id for number in range(4)]
    round_trips = counted_round_trips(monkeypatch)

    async def read(job_id: str) -> str:
        return "".join([text async for text in event_stream(services, job_id, None)])

    async def read_all() -> list[str]:
        return await asyncio.gather(*(read(jobs[number % 4]) for number in range(streams)))

    texts = asyncio.run(read_all())
    assert round_trips == ["pipeline"]
    assert all(text.count('"status": "failed"') == 1 for text in texts)


def test_a_stream_that_comes_during_a_look_is_answered_by_the_next(redis: Redis) -> None:
    store = RecordStore(redis)
    started(store)
    looks: list[list[Position]] = []

    async def run() -> list[JobNews]:
        loop = asyncio.get_running_loop()
        late: list[asyncio.Task[JobNews]] = []

        def look(positions: Sequence[Position]) -> list[JobNews]:
            looks.append(list(positions))
            if len(looks) == 1:
                asked = asyncio.run_coroutine_threadsafe(_begin(watch, late), loop)
                asked.result(30)
            return store.news(positions)

        watch = JobWatch(look, asyncio.Event())
        first = await watch.news("j1", None)
        return [first, *await asyncio.gather(*late)]

    first, second = asyncio.run(run())
    assert first == second
    assert looks == [[("j1", None)], [("j1", None)]]


async def _begin(watch: JobWatch, late: list[asyncio.Task[JobNews]]) -> None:
    late.append(asyncio.create_task(watch.news("j1", None)))
    await asyncio.sleep(0)


def test_a_store_that_is_away_ends_the_streams_not_the_watch() -> None:
    answers: list[object] = [RedisConnectionError("away"), [JobNews(None, [])]]

    def look(positions: Sequence[Position]) -> list[JobNews]:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, list)
        return answer

    async def run() -> None:
        watch = JobWatch(look, asyncio.Event())
        outcomes = await asyncio.gather(watch.news("j", None), watch.news("j", None), return_exceptions=True)
        assert [type(outcome) for outcome in outcomes] == [RedisConnectionError] * 2
        assert (await watch.news("j", None)).record is None

    asyncio.run(run())

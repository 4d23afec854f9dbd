"""The application as a whole: what it loads, what it needs, and how it ends."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest
from redis import Redis
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError

from regnf_service import server
from regnf_service.concurrency import Waiters
from regnf_service.http.body import pause, wait_for
from regnf_service.http.sse import event_stream
from regnf_service.server import create_app, stopping_on_signals
from regnf_service.services import JobWatch, Position
from regnf_state.records import JobNews
from regnf_state.redis.client import NoRedisError
from regnf_state.redis.jobs import RecordStore
from regnf_state.settings import Settings
from tests.contract.world import make_world
from tests.round_trips import counted_round_trips
from tests.state.record_makers import finished, started
from tests.stores import services_over


def test_the_application_loads_neither_torch_nor_open3d() -> None:
    heavy = "{'torch', 'open3d', 'regnf_worker', 'numpy'}"
    code = f"import sys, regnf_service.server; sys.exit(' '.join({heavy} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_it_says_what_it_needs(tmp_path: Path) -> None:
    with pytest.raises(NoRedisError, match="REGNF_REDIS_URL"):
        create_app(Settings(state_dir=tmp_path, redis_url=None))


def test_signals_end_long_answers_and_reach_the_server_too() -> None:
    heard: list[int] = []

    async def run() -> bool:
        stopping = asyncio.Event()
        with stopping_on_signals(stopping):
            os.kill(os.getpid(), signal.SIGTERM)
            return await pause(20.0, stopping)

    before = signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    try:
        assert asyncio.run(run()) is True
        assert heard == [signal.SIGTERM]
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard == [signal.SIGTERM] * 2
    finally:
        signal.signal(signal.SIGTERM, before)


def test_waiting_ends_when_the_service_stops(tmp_path: Path, any_redis: Redis) -> None:
    services = make_world(tmp_path, any_redis).app.state.services

    async def run() -> int:
        asyncio.get_running_loop().call_later(0.05, services.stopping.set)
        return await wait_for(lambda: 1, lambda _: False, 60.0, services, "alice")

    assert asyncio.run(asyncio.wait_for(run(), 20)) == 1


def test_where_many_answers_are_held_no_more_are(tmp_path: Path, any_redis: Redis) -> None:
    """A held answer keeps its connection: enough of them would leave none for anybody else."""
    services = make_world(tmp_path, any_redis).app.state.services
    services.waiters = Waiters(most=1)
    looks: list[int] = []

    async def ask() -> int:
        return await wait_for(lambda: looks.append(1) or len(looks), lambda _: False, 600.0, services, "alice")

    with services.waiters.held("alice"):
        assert asyncio.run(asyncio.wait_for(ask(), 20)) == len(looks) == 1


def test_a_caller_has_half_of_the_answers_that_are_held() -> None:
    waiters = Waiters(most=4)
    with waiters.held("alice"), waiters.held("alice"):
        assert not waiters.has_room("alice")
        assert waiters.has_room("bob")
        with waiters.held("bob"), waiters.held("carol"):
            assert not waiters.has_room("dave"), "all together have as many as there may be"
    assert waiters.has_room("alice")


def test_the_more_answers_a_caller_holds_the_more_seldom_each_looks() -> None:
    waiters = Waiters(looks_per_s=20.0)
    with ExitStack() as stack:
        stack.enter_context(waiters.held("bob"))
        stack.enter_context(waiters.held("alice"))
        assert 0.1875 <= waiters.pause_s("alice", 0.25) <= 0.3125
        for _ in range(9):
            stack.enter_context(waiters.held("alice"))
        assert 0.75 <= waiters.pause_s("alice", 0.25) <= 1.25
        assert 1.5 <= waiters.pause_s("alice", 2.0) <= 2.5
        several = {waiters.pause_s("alice", 2.0) for _ in range(5)}
        assert len(several) > 1, "those that began together do not stay together"
        assert waiters.pause_s("bob", 0.02) <= 0.125, "others' answers slow his down no further than to his half"
    assert waiters.pause_s("alice", 0.02) <= 0.025


def test_a_fault_in_a_round_of_the_reaper_is_logged_and_the_next_one_comes(
    tmp_path: Path, any_redis: Redis, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faults: list[Exception] = [RedisError("away"), OSError("away"), KeyError("of ours")]

    async def run() -> None:
        services = services_over(any_redis, Settings(state_dir=tmp_path))
        loop = asyncio.get_running_loop()

        class FaultyReaper:
            def __init__(self, *_: object) -> None:
                pass

            def run_once(self) -> None:
                if not faults:
                    loop.call_soon_threadsafe(services.stopping.set)
                    return
                raise faults.pop()

        monkeypatch.setattr(server, "Reaper", FaultyReaper)
        monkeypatch.setattr(server, "_REAP_EVERY_S", 0.001)
        await asyncio.wait_for(server._reap(services), 20)

    asyncio.run(run())
    assert not faults
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING", "WARNING"]


# all event streams of a process share their looks at the store


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

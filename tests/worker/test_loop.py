"""The worker's loop when every word of it may be refused: what it waits for, what it leaves undone, what ends it."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis
from redis.client import Pipeline
from redis.exceptions import OutOfMemoryError, ResponseError

from regnf_state.queue import Work
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings
from regnf_worker import kernel, process
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context
from regnf_worker.process import RegnfWorker
from tests.worker.refusals import FULL, PASSING, RefusingRedis

WORK = [Work("registration", letter, 1).name for letter in "ab"]


class ChildlessWorker(RegnfWorker):
    """Does what a worker does around a job, notes the job instead of forking for it, and stops when all is done."""

    def _run_child(self, work: Work, folder: Path) -> kernel.Exit:
        done.append(work.name)
        self._must_end(work, 0, folder, limited=False)
        return kernel.Exit(signal.SIGKILL)

    def _settle(self, *_: object) -> None:
        """There are no records here."""
        if len(done) == len(WORK):
            self._stop(0, None)


done: list[str] = []


@pytest.fixture
def signals_restored() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def worker_over(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, redis: RefusingRedis, redis_url: str
) -> Iterator[Callable[[], ChildlessWorker]]:
    """Makes workers who have nothing but their own connection refused."""
    monkeypatch.setattr(process, "connect", lambda *_, **__: redis)
    context = Context.from_settings(Settings(redis_url=redis_url, state_dir=tmp_path))
    scratch = Scratch(tmp_path)
    yield lambda: ChildlessWorker(context, scratch)
    scratch.remove()


def work_off(redis: RefusingRedis, worker_over: Callable[[], ChildlessWorker], refuse_at: int, error: Exception) -> int:
    """Have a fresh worker work off a queue of two with one command refused; how many commands that took."""
    redis.refuse_at = -1
    redis.flushall()
    for letter in "ab":
        JobQueue(redis).enqueue_registration(letter, 1)
    worker = worker_over()
    done.clear()
    redis.sent, redis.refuse_at, redis.error = 0, refuse_at, error
    worker.serve()
    return redis.sent


@pytest.mark.usefixtures("signals_restored", "waits")
@pytest.mark.parametrize("error", [FULL, PASSING[1], PASSING[2], PASSING[4]], ids=["full", "away", "slow", "disk"])
def test_no_refused_command_ends_the_loop_or_loses_work(
    redis: RefusingRedis, worker_over: Callable[[], ChildlessWorker], error: Exception
) -> None:
    commands = work_off(redis, worker_over, -1, error)
    assert done == WORK
    assert commands > 20
    for number in range(commands):
        work_off(redis, worker_over, number, error)
        assert redis.sent > number, "the command was reached, and refused"
        assert done == WORK, redis.refused


@pytest.mark.usefixtures("signals_restored", "waits")
def test_an_error_that_does_not_pass_ends_the_loop(
    redis: RefusingRedis, worker_over: Callable[[], ChildlessWorker]
) -> None:
    redis.set("regnf:workers", "no sorted set")
    with pytest.raises(ResponseError, match="WRONGTYPE"):
        worker_over().serve()


def test_a_worker_is_known_by_the_name_that_the_health_check_reads(
    redis: RefusingRedis, worker_over: Callable[[], ChildlessWorker]
) -> None:
    worker = worker_over()
    for _ in range(2):
        redis.flushall()
        assert worker.next_work() is None
        assert JobQueue(redis).workers() == [worker.name], "also after Redis has forgotten it"


def test_a_lost_report_beside_a_child_is_not_repeated(
    redis: RefusingRedis, worker_over: Callable[[], ChildlessWorker], waits: list[float], tmp_path: Path
) -> None:
    worker, redis.refuse_at = worker_over(), redis.sent
    worker._started = time.monotonic()
    assert not worker._must_end(Work("registration", "a", 1), 0, tmp_path, limited=False)
    assert waits == []


def test_the_pipeline_of_a_refusing_redis_is_a_real_one(redis: RefusingRedis) -> None:
    """The double stands on this: pipelines go through ``execute``, and what is refused was not sent."""
    pipeline: Any = redis.pipeline()
    assert isinstance(pipeline, Pipeline)
    assert isinstance(redis, Redis)
    redis.refuse_at = redis.sent
    pipeline.set("key", 1)
    with pytest.raises(OutOfMemoryError):
        pipeline.execute()
    assert redis.get("key") is None

"""RQ's loop when its every word to Redis may be refused: what it waits for, what it leaves undone, what ends it."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis
from redis.client import Pipeline
from redis.exceptions import OutOfMemoryError, ResponseError
from rq.exceptions import StopRequested
from rq.worker.base import BaseWorker

from regnf_state.queue import Work
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import Settings
from regnf_worker import kernel, process
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context
from regnf_worker.process import RegnfWorker
from regnf_worker.resilient_worker import ResilientWorker
from tests.worker.refusals import FULL, LASTING, PASSING, Refusals, RefusingRedis

# RQ's calls, one by one


def offline_worker() -> ResilientWorker:
    """Nothing that a test calls here reaches for Redis."""
    return ResilientWorker(["q"], connection=Redis(), prepare_for_work=False)


TRIED: list[tuple[str, tuple[Any, ...]]] = [
    ("subscribe", ()),
    ("check_for_suspension", (False,)),
]
LEFT_UNDONE: list[tuple[str, tuple[Any, ...]]] = [
    ("set_state", ("idle", None)),
    ("teardown", ()),
]


def fake(monkeypatch: pytest.MonkeyPatch, name: str, refusals: Refusals) -> None:
    """RQ's own method of this name, seen as a method."""
    monkeypatch.setattr(BaseWorker, name, lambda *arguments: refusals(*arguments))


@pytest.mark.parametrize(("name", "arguments"), TRIED, ids=lambda value: value if isinstance(value, str) else "")
def test_what_must_be_is_tried_until_it_is(
    monkeypatch: pytest.MonkeyPatch, waits: list[float], name: str, arguments: tuple[Any, ...]
) -> None:
    refusals = Refusals(3)
    fake(monkeypatch, name, refusals)
    getattr(offline_worker(), name)(*arguments)
    assert [call[1:] for call in refusals.calls] == [arguments] * 4
    assert len(waits) == 3


@pytest.mark.parametrize(("name", "arguments"), TRIED, ids=lambda value: value if isinstance(value, str) else "")
def test_a_worker_told_to_stop_while_busy_tries_no_more(
    monkeypatch: pytest.MonkeyPatch, waits: list[float], name: str, arguments: tuple[Any, ...]
) -> None:
    fake(monkeypatch, name, Refusals(9))
    worker = offline_worker()
    worker._stop_requested = True
    with pytest.raises(StopRequested):
        getattr(worker, name)(*arguments)
    assert waits == []


@pytest.mark.parametrize(("name", "arguments"), LEFT_UNDONE, ids=lambda value: value if isinstance(value, str) else "")
@pytest.mark.parametrize("error", [FULL, LASTING], ids=["full", "wrong"])
def test_what_need_not_be_is_left_undone(
    monkeypatch: pytest.MonkeyPatch, waits: list[float], name: str, arguments: tuple[Any, ...], error: Exception
) -> None:
    refusals = Refusals(1, error)
    fake(monkeypatch, name, refusals)
    getattr(offline_worker(), name)(*arguments)
    assert [call[1:] for call in refusals.calls] == [arguments]
    assert waits == []


@pytest.mark.parametrize("error", [FULL, LASTING], ids=["full", "wrong"])
def test_sweeping_may_be_left_undone(monkeypatch: pytest.MonkeyPatch, waits: list[float], error: Exception) -> None:
    refusals = Refusals(1, error)
    worker = offline_worker()
    monkeypatch.setattr(worker, "_sweep_entries", refusals)
    worker.run_maintenance_tasks()
    assert (len(refusals.calls), waits) == (1, [])


@pytest.mark.parametrize(("horse", "tries"), [(0, 4), (123, 1)])
def test_a_sign_of_life_waits_unless_a_child_runs(
    monkeypatch: pytest.MonkeyPatch, waits: list[float], horse: int, tries: int
) -> None:
    worker = offline_worker()
    worker._horse_pid = horse
    refusals = Refusals(3)
    monkeypatch.setattr(worker, "_report", refusals)
    worker.heartbeat()
    assert len(refusals.calls) == tries


# the loop, over a real Redis of which every command in turn is refused


class ChildlessWorker(RegnfWorker):
    """Does what a worker does around a job, and notes the job instead of forking for it."""

    def _run_child(self, job: Any, *_: Any) -> kernel.Exit | None:
        done.append(job.id)
        self._if_possible("a sign of life", lambda: self.maintain_heartbeats(job))
        return kernel.Exit(signal.SIGKILL)

    def _settle(self, *_: object) -> None:
        """There are no records here."""


done: list[str] = []


@pytest.fixture
def signals_restored() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def no_ear(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread listens for commands: its end takes a second."""
    monkeypatch.setattr("redis.client.PubSub.run_in_thread", lambda *_, **__: None)


WORK = [Work("import", letter * 64, 1).name for letter in "ab"]


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
        JobQueue(redis).enqueue_import(letter * 64)
    worker = worker_over()
    done.clear()
    redis.sent, redis.refuse_at, redis.error = 0, refuse_at, error
    assert worker.work(burst=True, logging_level=None)
    return redis.sent


@pytest.mark.usefixtures("signals_restored", "waits", "no_ear")
@pytest.mark.parametrize("error", [FULL, PASSING[1], PASSING[2], PASSING[4]], ids=["full", "away", "slow", "disk"])
def test_no_refused_command_ends_the_loop_or_loses_work(
    redis: RefusingRedis,
    worker_over: Callable[[], ChildlessWorker],
    caplog: pytest.LogCaptureFixture,
    error: Exception,
) -> None:
    commands = work_off(redis, worker_over, -1, error)
    assert done == WORK
    assert commands > 25
    for number in range(commands):
        work_off(redis, worker_over, number, error)
        assert redis.sent > number, "the command was reached, and refused"
        assert done == WORK, redis.refused
    assert "unhandled exception" not in caplog.text


@pytest.mark.usefixtures("signals_restored", "waits", "no_ear")
def test_an_error_that_does_not_pass_still_ends_the_loop(
    redis: RefusingRedis, worker_over: Callable[[], ChildlessWorker]
) -> None:
    JobQueue(redis).enqueue_import("a" * 64)
    worker = worker_over()
    redis.set(worker.redis_workers_keys, "not a set")
    with pytest.raises(ResponseError, match="WRONGTYPE"):
        worker.work(burst=True, logging_level=None)


@pytest.mark.usefixtures("waits")
def test_a_birth_whose_answer_was_lost_is_not_another_workers(redis: RefusingRedis) -> None:
    worker = ResilientWorker(["q"], connection=redis)
    worker.register_birth()
    worker.register_birth()
    assert redis.scard("rq:workers:q") == 1


def test_a_worker_that_redis_forgot_is_known_again_after_its_next_report(redis: RefusingRedis) -> None:
    worker = ResilientWorker(["regnf"], connection=redis)
    worker.register_birth()
    for report in (worker.heartbeat, lambda: redis_pipeline_report(redis, worker)):
        redis.flushall()
        report()
        assert JobQueue(redis).live_workers() == 1
        assert redis.hget(worker.key, "hostname") == worker.hostname.encode(), "the container's health check reads it"
        assert 0 < redis.ttl(worker.key) <= 45


def redis_pipeline_report(redis: Redis, worker: ResilientWorker) -> None:
    with redis.pipeline() as pipeline:
        worker.heartbeat(5, pipeline)
        pipeline.execute()


def test_the_pipeline_of_a_refusing_redis_is_a_real_one(redis: RefusingRedis) -> None:
    """The double stands on this: pipelines go through ``execute``, and what is refused was not sent."""
    pipeline = redis.pipeline()
    assert isinstance(pipeline, Pipeline)
    redis.refuse_at = redis.sent
    pipeline.set("key", 1)
    with pytest.raises(OutOfMemoryError):
        pipeline.execute()
    assert redis.get("key") is None

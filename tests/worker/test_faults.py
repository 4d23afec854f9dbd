"""Stores that go away, workers that freeze: what the service promises all the same."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from redis import Redis
from redis.exceptions import RedisError

from regnf_service.upkeep.reaper import Reaper
from regnf_state.manifest import read_manifest
from tests.restartable_redis import RestartableRedis, restartable_redis
from tests.worker.bench import Bench, bench, children_of, eventually

Full = Callable[[], AbstractContextManager[None]]


@pytest.fixture
def server() -> Iterator[RestartableRedis]:
    with restartable_redis() as made:
        yield made


@pytest.fixture
def table(tmp_path: Path, server: RestartableRedis) -> Iterator[Bench]:
    with bench(tmp_path, redis_url=server.url) as made:
        made.add_ready_fields()
        yield made


def test_a_restart_of_redis_while_idle(table: Bench, server: RestartableRedis) -> None:
    worker = table.start_worker()
    server.kill()
    server.start()
    table.submit("succeed")
    assert table.finished().status == "successful"
    assert worker.poll() is None


def test_a_restart_of_redis_while_a_job_runs(table: Bench, server: RestartableRedis) -> None:
    worker = table.start_worker()
    table.submit("wait_for_file")
    table.reaches("sampling")
    server.kill()
    server.start()
    assert table.job().status == "running"
    (table.context.settings.state_dir / "go").write_bytes(b"")
    done = table.finished()
    assert (done.status, done.attempt) == ("successful", 1)
    assert worker.poll() is None
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"


def test_redis_away_between_result_and_word_of_it(table: Bench, server: RestartableRedis) -> None:
    """The manifest stands, the record does not know: whoever looks next finds the result and runs nothing again."""
    worker = table.start_worker()
    table.submit("wait_for_file")
    table.reaches("sampling")
    worker.kill()
    worker.wait()
    table.context.blobs.put("jobs/j1/manifest.json", b'{"attempt": 1, "artifacts": []}')
    reaper = Reaper(
        table.context.records,
        table.context.queue,
        table.redis,
        table.context.settings.model_copy(update={"lost_after_s": 0.5}),
    )
    eventually(lambda: reaper.run_once().requeued, "the lost job's requeueing")
    table.start_worker()
    done = table.finished()
    assert (done.status, done.attempt, done.engine) == ("successful", 2, {})


def test_a_frozen_worker_loses_to_the_newer_attempt(table: Bench) -> None:
    """SIGSTOP, then another worker does the job; the frozen one, continued, changes nothing and stops."""
    frozen = table.start_worker()
    table.submit("wait_for_file")
    table.reaches("sampling")
    (child,) = children_of(frozen.pid)
    for pid in (child, frozen.pid):
        os.kill(pid, signal.SIGSTOP)
    settings = table.context.settings.model_copy(update={"lost_after_s": 1.0})
    reaper = Reaper(table.context.records, table.context.queue, table.redis, settings)
    eventually(lambda: reaper.run_once().requeued, "the silent job's requeueing")
    (table.context.settings.state_dir / "go").write_bytes(b"")
    table.start_worker()
    done = table.finished()
    assert (done.status, done.attempt) == ("successful", 2)
    manifest = read_manifest(table.context.blobs, "j1")
    for pid in (child, frozen.pid):
        os.kill(pid, signal.SIGCONT)
    eventually(lambda: not children_of(frozen.pid), "the older attempt's end")
    assert table.job() == done
    assert read_manifest(table.context.blobs, "j1") == manifest
    assert not list(table.context.blobs.list("jobs/j1/1")), "nothing of the older attempt stays"
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"


def test_redis_forgets_everything(table: Bench) -> None:
    """FLUSHALL while a job runs: the job has no record any more, stops, and the worker goes on."""
    worker = table.start_worker()
    table.submit("iterate")
    table.reaches("optimizing")
    table.redis.flushall()
    eventually(lambda: not children_of(worker.pid), "the end of a job that nobody knows")
    table.add_ready_fields()
    table.submit("succeed", "next")
    table_done = table.finished("next")
    assert table_done.status == "successful"
    eventually(lambda: table.context.queue.live_workers() == 1, "the worker's being known again")


@pytest.fixture
def full(table: Bench) -> Full:
    """Redis takes no writes for as long as the block lasts, and at least until a worker has met with that."""

    @contextmanager
    def lasting() -> Iterator[None]:
        table.redis.config_set("maxmemory", 1)
        yield
        eventually(lambda: "Redis refuses" in table.log(), table.log)
        table.redis.config_set("maxmemory", 0)

    return lasting


def test_a_full_redis_refuses_and_recovers(table: Bench) -> None:
    worker = table.start_worker()
    redis: Redis = table.redis
    redis.config_set("maxmemory", 1)
    with pytest.raises(RedisError):
        table.submit("succeed")
    redis.config_set("maxmemory", 0)
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    assert worker.poll() is None, "one worker, the same all the while"


def test_a_worker_that_starts_at_a_full_redis(table: Bench, full: Full) -> None:
    with full():
        worker = table.launch_worker()
    table.submit("succeed")
    assert table.finished().status == "successful"
    assert worker.poll() is None
    assert table.context.queue.live_workers() == 1


def test_a_worker_told_to_stop_at_a_full_redis(table: Bench, full: Full) -> None:
    with full():
        worker = table.launch_worker()
        eventually(lambda: "Redis refuses" in table.log(), table.log)
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(30) == 0
    assert "Traceback" not in table.log()


@pytest.mark.parametrize("do", ["wait_for_file", "refuse_after_file"])
def test_a_job_caught_by_a_full_redis_loses_nothing(table: Bench, full: Full, do: str) -> None:
    """Its end cannot be written down: it waits with what it has found, and so does its worker."""
    worker = table.start_worker()
    table.submit(do)
    table.reaches("sampling")
    with full():
        (table.context.settings.state_dir / "go").write_bytes(b"")
    done = table.finished()
    assert (done.status, done.attempt) == ("successful" if do == "wait_for_file" else "failed", 1)
    assert (done.error or {}).get("reason") == (None if do == "wait_for_file" else "NO_SURFACE_IN_DETECTION")
    assert worker.poll() is None
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"


def test_a_child_that_dies_at_a_full_redis_is_settled_afterwards(table: Bench, full: Full) -> None:
    worker = table.start_worker()
    table.submit("wait_for_file")
    table.reaches("sampling")
    (child,) = children_of(worker.pid)
    with full():
        os.kill(child, signal.SIGKILL)
        (table.context.settings.state_dir / "go").write_bytes(b"")
    done = table.finished()
    assert (done.status, done.attempt, done.requeues) == ("successful", 2, 1)
    assert worker.poll() is None
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"

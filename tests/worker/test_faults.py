"""A Redis that forgets, or takes no writes: what a worker makes of it. Restarts, deaths, freezes: tests/faults."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from tests.processes import children_of
from tests.restartable_redis import RestartableRedis, restartable_redis
from tests.worker.bench import Bench, bench, eventually

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


def test_a_refusal_caught_by_a_full_redis_is_not_lost(table: Bench, full: Full) -> None:
    """Its end cannot be written down: it waits with what it has found, and so does its worker."""
    worker = table.start_worker()
    table.submit("refuse_after_file")
    table.reaches("sampling")
    with full():
        (table.context.settings.state_dir / "go").write_bytes(b"")
    done = table.finished()
    assert (done.status, done.attempt) == ("failed", 1)
    assert (done.error or {}).get("reason") == "NO_SURFACE_IN_DETECTION"
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

"""Waiting for a Redis that refuses: how long, for what, and that jobs lose nothing by it."""

import os
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from redis import Redis
from redis.exceptions import RedisError
from rq import Queue
from rq.exceptions import StopRequested

from regnf_state.queue import Work
from regnf_state.records import FieldRecord
from regnf_state.redis.queue import made
from regnf_state.settings import Settings
from regnf_worker import kernel
from regnf_worker.attempt import run_attempt
from regnf_worker.imports import run_import_attempt
from regnf_worker.kernel import Scratch
from regnf_worker.models import Context
from regnf_worker.process import RegnfWorker
from regnf_worker.resilient_worker import MAX_WAIT_S, passes, retry_until_available
from tests.worker.doubles import SHA, accept, context_over
from tests.worker.refusals import FULL, LASTING, PASSING, Refusals, RefusingRedis, refuse
from tests.worker.tiny_engine import TinyEngine, tiny_importer

# waiting


def test_waits_grow_and_are_bounded(waits: list[float]) -> None:
    do = Refusals(8, answer="done")
    assert retry_until_available("it", do) == "done"
    assert len(do.calls) == 9
    assert waits == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0, 2.0]
    assert max(waits) == MAX_WAIT_S


@pytest.mark.parametrize("error", PASSING, ids=str)
def test_what_passes_is_waited_for(waits: list[float], error: RedisError) -> None:
    assert passes(error)
    assert retry_until_available("it", Refusals(2, error, answer=3)) == 3


@pytest.mark.parametrize("error", [LASTING, StopRequested(), ValueError()], ids=repr)
def test_what_does_not_pass_is_raised_at_once(waits: list[float], error: Exception) -> None:
    do = Refusals(1, error)
    with pytest.raises(type(error)):
        retry_until_available("it", do)
    assert (len(do.calls), waits) == (1, [])


def test_who_is_told_to_stop_waits_no_longer(waits: list[float]) -> None:
    do = Refusals(9)
    with pytest.raises(StopRequested):
        retry_until_available("it", do, stopped=lambda: len(do.calls) == 3)
    assert len(do.calls) == 3
    assert retry_until_available("it", Refusals(0, answer=1), stopped=lambda: True) == 1, (
        "what succeeds is not given up"
    )


def test_a_refusal_and_its_end_are_logged_once(waits: list[float], caplog: pytest.LogCaptureFixture) -> None:
    retry_until_available("the claim", Refusals(5))
    assert [record.message for record in caplog.records] == [
        f"the claim: Redis refuses the command; trying again: {FULL}",
        "the claim: done after 5 refusals",
    ]


# our own worker around a job


@pytest.fixture
def worker(tmp_path: Path, any_redis: Redis, redis: RefusingRedis, monkeypatch: pytest.MonkeyPatch) -> RegnfWorker:
    monkeypatch.setattr("regnf_worker.process.connect", lambda *_, **__: redis)
    settings = Settings(state_dir=tmp_path, redis_url="unix:///nowhere")
    context = context_over(any_redis, settings)
    return RegnfWorker(context, Scratch(tmp_path / "scratch"))


def execute(worker: RegnfWorker) -> None:
    work = Work("registration", "j1", 1)
    worker.execute_job(made(work, worker.connection), Queue(work.queue_name, connection=worker.connection))


@pytest.mark.parametrize("killed", [False, True])
def test_the_process_of_the_next_import_waits_for_it(worker: RegnfWorker, tmp_path: Path, killed: bool) -> None:
    def note(argument: str, attempt: int, name: str) -> None:
        (tmp_path / "ran").write_text(f"{argument} {attempt} {os.getpid()} {tempfile.gettempdir()}")

    worker._functions = {"import": note, "registration": note}
    waiting = worker._next_import = worker._forked()
    if killed:
        os.kill(waiting[0], signal.SIGKILL)
        os.waitid(os.P_PID, waiting[0], os.WEXITED | os.WNOWAIT)
    folder = worker._scratch.of_job()
    child, ended = worker._start_child(Work("import", SHA, 2), folder)
    assert (child == waiting[0]) == (not killed)
    assert worker._next_import is None
    exit_ = None
    while exit_ is None:
        exit_ = kernel.wait_for_exit(child, ended, 5.0)
    os.close(ended)
    assert exit_ != "spoken"
    assert exit_.status == 0
    assert (tmp_path / "ran").read_text() == f"{SHA} 2 {child} {folder}"
    worker._scratch.remove()


def test_a_job_taken_but_not_begun_is_left_to_the_reaper(worker: RegnfWorker, monkeypatch: pytest.MonkeyPatch) -> None:
    accept(worker._context)
    before = worker._context.records.get_job("j1")
    monkeypatch.setattr("rq.worker.base.BaseWorker.prepare_execution", lambda *_: Refusals(9)())
    worker._stop_requested = True
    with pytest.raises(StopRequested):
        execute(worker)
    assert worker._context.records.get_job("j1") == before


def test_a_job_is_settled_once_redis_takes_it(
    worker: RegnfWorker, monkeypatch: pytest.MonkeyPatch, waits: list[float]
) -> None:
    """The child died because Redis was full, and Redis is still full when its parent wants to say so."""
    accept(worker._context)
    refuse(monkeypatch, worker._context, "update_job", 3)
    worker.register_birth()
    monkeypatch.setattr(worker, "_run_child", lambda *_: kernel.Exit(status=None))
    execute(worker)
    again = worker._context.records.get_job("j1")
    assert again is not None
    assert (again.status, again.attempt, again.requeues) == ("accepted", 2, 1)
    assert len(waits) == 3


# a job in its child


@pytest.fixture
def context(tmp_path: Path, any_redis: Redis) -> Context:
    settings = Settings(state_dir=tmp_path, heartbeat_s=60)
    return context_over(any_redis, settings)


@pytest.mark.parametrize("name", ["update_job", "heartbeat"])
@pytest.mark.parametrize(("do", "status"), [("succeed", "successful"), ("refuse", "failed")])
def test_a_job_waits_for_redis_and_loses_nothing(
    context: Context, monkeypatch: pytest.MonkeyPatch, waits: list[float], name: str, do: str, status: str
) -> None:
    """Each of its writes in turn is refused twice: progress is skipped, the rest waited for."""
    accept(context, do)
    real: Callable[..., Any] = getattr(context.records, name)
    calls: list[int] = []

    def every_third(*arguments: Any, **changes: Any) -> Any:
        calls.append(1)
        if len(calls) % 3:
            raise FULL
        return real(*arguments, **changes)

    monkeypatch.setattr(context.records, name, every_third)
    run_attempt(context, "j1", 1, "w", TinyEngine)
    job = context.records.get_job("j1")
    assert job is not None
    assert (job.status, job.attempt, job.engine["version"]) == (status, 1, "tiny")
    if calls:
        assert waits


@pytest.mark.parametrize("name", ["set_if_absent", "update_field"])
@pytest.mark.parametrize(("data", "state"), [(b"f", "ready"), (b"raise", "rejected")])
def test_an_import_waits_for_redis_and_rejects_nothing_for_it(
    context: Context, monkeypatch: pytest.MonkeyPatch, waits: list[float], name: str, data: bytes, state: str
) -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    context.blobs.put(f"fields/{SHA}/original", data)
    refuse(monkeypatch, context, name, 2)

    def importer(*given: Any) -> dict[str, Any]:
        if given[0].read_bytes() == b"raise":
            raise ValueError("no field")
        return tiny_importer(*given)

    run_import_attempt(context, SHA, 1, "w", importer)
    field = context.records.get_field(SHA)
    assert field is not None
    assert field.state == state
    assert len(waits) == 2

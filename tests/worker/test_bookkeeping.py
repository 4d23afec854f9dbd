"""A worker whose every word to Redis may be refused: what it waits for, what it leaves undone, what ends it."""

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis
from redis.client import Pipeline
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import OutOfMemoryError, ReadOnlyError, RedisError, ResponseError
from redis.exceptions import TimeoutError as RedisTimeoutError
from rq import Queue
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from rq.worker.base import BaseWorker

from service.memory import InMemoryBlobStore, InMemoryJobQueue, InMemoryRecordStore
from service.records import FieldRecord, JobRecord
from service.redis_queue import RqJobQueue
from service.settings import Settings
from tests.redis_server import private_redis
from tests.worker.tiny_engine import TinyEngine, tiny_importer
from worker.bookkeeping import PatientWorker
from worker.context import Context
from worker.imports import run_import_attempt
from worker.patience import LONGEST_WAIT_S, passes, patiently
from worker.process import RegnfWorker
from worker.registration import run_attempt
from worker.scratch import Scratch

FULL = OutOfMemoryError("command not allowed when used memory > 'maxmemory'.")
PASSING = [
    FULL,
    RedisConnectionError("Connection refused"),
    RedisTimeoutError("Timeout reading from socket"),
    ReadOnlyError("You can't write against a read only replica."),
    ResponseError("MISCONF Errors writing to the AOF file: No space left on device"),
    ResponseError("Command # 1 (HSET k v) of pipeline caused error: MISCONF Errors writing to the AOF file"),
    ResponseError("Error running script (call to f_0): @user_script:5: -OOM command not allowed"),
]
LASTING = ResponseError("WRONGTYPE Operation against a key holding the wrong kind of value")
SHA = "a" * 64


class Refusals:
    """Raises the error the first ``count`` times that it is called; notes what it was called with."""

    def __init__(self, count: int, error: Exception = FULL, answer: object = None) -> None:
        self.left, self.error, self.answer = count, error, answer
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, *arguments: Any) -> Any:
        self.calls.append(arguments)
        if self.left:
            self.left -= 1
            raise self.error
        return self.answer


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Nobody sleeps; the list says how long they would have slept."""
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    return slept


# waiting


def test_waits_grow_and_are_bounded(waits: list[float]) -> None:
    do = Refusals(8, answer="done")
    assert patiently("it", do) == "done"
    assert len(do.calls) == 9
    assert waits == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0, 2.0]
    assert max(waits) == LONGEST_WAIT_S


@pytest.mark.parametrize("error", PASSING, ids=str)
def test_what_passes_is_waited_for(waits: list[float], error: RedisError) -> None:
    assert passes(error)
    assert patiently("it", Refusals(2, error, answer=3)) == 3


@pytest.mark.parametrize("error", [LASTING, StopRequested(), ValueError()], ids=repr)
def test_what_does_not_pass_is_raised_at_once(waits: list[float], error: Exception) -> None:
    do = Refusals(1, error)
    with pytest.raises(type(error)):
        patiently("it", do)
    assert (len(do.calls), waits) == (1, [])


def test_who_is_told_to_stop_waits_no_longer(waits: list[float]) -> None:
    do = Refusals(9)
    with pytest.raises(StopRequested):
        patiently("it", do, stopped=lambda: len(do.calls) == 3)
    assert len(do.calls) == 3
    assert patiently("it", Refusals(0, answer=1), stopped=lambda: True) == 1, "what succeeds is not given up"


def test_a_refusal_and_its_end_are_logged_once(waits: list[float], caplog: pytest.LogCaptureFixture) -> None:
    patiently("the claim", Refusals(5))
    assert [record.message for record in caplog.records] == [
        f"the claim: Redis refuses, trying until it does not: {FULL}",
        "the claim: done after 5 refusals",
    ]


# RQ's calls, one by one


def offline_worker() -> PatientWorker:
    """Nothing that a test calls here reaches for Redis."""
    return PatientWorker(["q"], connection=Redis(), prepare_for_work=False)


class Named:
    id = "j1-1"


TRIED: list[tuple[str, tuple[Any, ...]]] = [
    ("subscribe", ()),
    ("check_for_suspension", (False,)),
    ("dequeue_job_and_maintain_ttl", (5, None)),
    ("prepare_execution", (Named,)),
    ("prepare_job_execution", (Named, False)),
]
LEFT_UNDONE: list[tuple[str, tuple[Any, ...]]] = [
    ("set_state", ("idle", None)),
    ("run_maintenance_tasks", ()),
    ("teardown", ()),
    ("maintain_heartbeats", (Named,)),
    ("set_current_job_working_time", (1.5, None)),
]


def given(call: tuple[Any, ...]) -> tuple[Any, ...]:
    return call[1:]


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
    assert [given(call) for call in refusals.calls] == [arguments] * 4
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
    assert [given(call) for call in refusals.calls] == [arguments]
    assert waits == []


@pytest.mark.parametrize(("horse", "tries"), [(0, 4), (123, 1)])
def test_a_sign_of_life_waits_unless_a_child_runs(
    monkeypatch: pytest.MonkeyPatch, waits: list[float], horse: int, tries: int
) -> None:
    worker = offline_worker()
    worker._horse_pid = horse
    refusals = Refusals(3)
    monkeypatch.setattr(worker, "_report_now", refusals)
    worker.heartbeat()
    assert len(refusals.calls) == tries


@pytest.mark.parametrize("horse", [0, 123])
def test_books_refused_after_a_child_has_ended_do_not_end_the_worker(
    monkeypatch: pytest.MonkeyPatch, horse: int
) -> None:
    monkeypatch.setattr("rq.Worker.monitor_work_horse", lambda *_: Refusals(1)())
    worker = offline_worker()
    worker._horse_pid = horse
    if horse:
        with pytest.raises(OutOfMemoryError):
            worker.monitor_work_horse(Named, None)  # a child that still runs is not abandoned
    else:
        worker.monitor_work_horse(Named, None)


def test_the_handler_of_a_signal_does_not_write(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = offline_worker()
    monkeypatch.setattr(worker.connection, "execute_command", Refusals(1))
    worker.set_shutdown_requested_date()


# the loop, over a real Redis of which every command in turn is refused


class RefusingRedis(Redis):
    """Refuses its ``refuse_at``-th command, counted from zero, instead of sending it."""

    sent = 0
    refuse_at = -1
    error: Exception = FULL
    refused: tuple[Any, ...] = ()

    def count(self, *command: Any) -> None:
        self.sent += 1
        if self.sent - 1 == self.refuse_at:
            self.refused = command
            raise self.error

    def execute_command(self, *arguments: Any, **options: Any) -> Any:
        self.count(*arguments)
        return super().execute_command(*arguments, **options)

    def pipeline(self, *arguments: Any, **options: Any) -> Any:
        pipeline = super().pipeline(*arguments, **options)
        execute = pipeline.execute

        def counted(raise_on_error: bool = True) -> Any:
            self.count("PIPELINE")
            return execute(raise_on_error)

        pipeline.execute = counted  # type: ignore[method-assign]
        return pipeline


class ChildlessWorker(PatientWorker):
    """Does what a forking worker's parent does around a job, and notes the job instead of forking for it."""

    def execute_job(self, job: Any, queue: Any) -> None:
        self.prepare_execution(job)
        self.prepare_job_execution(job)
        done.append(job.id)
        self.set_current_job_working_time(0)
        self.maintain_heartbeats(job)
        self.set_state("idle")


done: list[str] = []


@pytest.fixture
def redis() -> Iterator[RefusingRedis]:
    with private_redis() as url, RefusingRedis.from_url(url) as client:
        yield client


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


def work_off(redis: RefusingRedis, refuse_at: int, error: Exception) -> int:
    """Have a fresh worker work off a queue of two jobs with one command refused; how many commands that took."""
    redis.refuse_at = -1
    redis.flushall()
    queue = Queue("q", connection=redis, serializer=JSONSerializer)
    for name in ("a", "b"):
        queue.enqueue("operator.neg", 1, job_id=name)
    worker = ChildlessWorker(["q", "other"], connection=redis, serializer=JSONSerializer)
    done.clear()
    redis.sent, redis.refuse_at, redis.error = 0, refuse_at, error
    assert worker.work(burst=True, logging_level=None)
    return redis.sent


@pytest.mark.usefixtures("signals_restored", "waits", "no_ear")
@pytest.mark.parametrize("error", [FULL, PASSING[1], PASSING[2], PASSING[4]], ids=["full", "away", "slow", "disk"])
def test_no_refused_command_ends_the_loop(
    redis: RefusingRedis, caplog: pytest.LogCaptureFixture, error: Exception
) -> None:
    commands = work_off(redis, -1, error)
    assert done == ["a", "b"]
    assert commands > 30
    lost = []
    for number in range(commands):
        work_off(redis, number, error)
        assert redis.sent > number, "the command was reached, and refused"
        if done != ["a", "b"]:
            lost.append((redis.refused[0], *sorted({"a", "b"} - set(done))))
    # read between leaving the queue and being known: the reaper finds an accepted job that no queue holds
    assert lost == [("HGETALL", "a"), ("HGETALL", "b")]
    assert "unhandled exception" not in caplog.text


@pytest.mark.usefixtures("signals_restored", "waits", "no_ear")
def test_an_error_that_does_not_pass_still_ends_the_loop(redis: RefusingRedis) -> None:
    Queue("q", connection=redis, serializer=JSONSerializer).enqueue("operator.neg", 1)
    worker = ChildlessWorker(["q", "other"], connection=redis, serializer=JSONSerializer)
    redis.set(worker.redis_workers_keys, "not a set")
    with pytest.raises(ResponseError, match="WRONGTYPE"):
        worker.work(burst=True, logging_level=None)


@pytest.mark.usefixtures("waits")
def test_a_birth_whose_answer_was_lost_is_not_another_workers(redis: RefusingRedis) -> None:
    worker = ChildlessWorker(["q"], connection=redis)
    worker.register_birth()
    worker.register_birth()
    assert redis.scard("rq:workers:q") == 1


def test_a_worker_that_redis_forgot_is_known_again_after_its_next_report(redis: RefusingRedis) -> None:
    worker = ChildlessWorker(["regnf"], connection=redis)
    worker.register_birth()
    for report in (worker.heartbeat, lambda: redis_pipeline_report(redis, worker)):
        redis.flushall()
        report()
        assert RqJobQueue(redis).live_workers() == 1
        assert redis.hget(worker.key, "hostname") == worker.hostname.encode(), "the container's health check reads it"
        assert 0 < redis.ttl(worker.key) <= 45


def redis_pipeline_report(redis: Redis, worker: PatientWorker) -> None:
    with redis.pipeline() as pipeline:
        worker.heartbeat(5, pipeline)
        pipeline.execute()


# our own worker around a job


@pytest.fixture
def worker(tmp_path: Path, redis: RefusingRedis, monkeypatch: pytest.MonkeyPatch) -> RegnfWorker:
    monkeypatch.setattr("worker.process.connect", lambda *_, **__: redis)
    settings = Settings(state_dir=tmp_path, redis_url="unix:///nowhere")
    context = Context(settings, InMemoryRecordStore(), InMemoryBlobStore(), InMemoryJobQueue())
    return RegnfWorker(context, Scratch(tmp_path / "scratch"))


class TakenJob:
    id = "j1-1"
    args = ("j1",)
    timeout = 1


class JobsQueue:
    name = "regnf"


def accept(context: Context, do: str = "succeed") -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "ready", 1, now, now))
    context.blobs.put(f"fields/{SHA}/field.safetensors", b"f")
    request = {"scene": SHA, "object": SHA, "options": {"do": do}}
    context.records.create_job(JobRecord("j1", "registration", "accepted", request, {}, now, now), 10)


def test_a_job_taken_but_not_begun_is_left_to_the_reaper(worker: RegnfWorker, monkeypatch: pytest.MonkeyPatch) -> None:
    accept(worker._context)
    before = worker._context.records.get_job("j1")
    fake(monkeypatch, "prepare_execution", Refusals(9))
    worker._stop_requested = True
    with pytest.raises(StopRequested):
        worker.execute_job(TakenJob, JobsQueue)
    assert worker._context.records.get_job("j1") == before


def test_a_job_is_settled_once_redis_takes_it(
    worker: RegnfWorker, monkeypatch: pytest.MonkeyPatch, waits: list[float]
) -> None:
    """The child died because Redis was full, and Redis is still full when its parent wants to say so."""
    accept(worker._context)
    refuse(monkeypatch, worker._context, "update_job", 3)
    monkeypatch.setattr("rq.Worker.execute_job", lambda *_: setattr(worker, "_begun", True))
    worker.execute_job(TakenJob, JobsQueue)
    again = worker._context.records.get_job("j1")
    assert again is not None
    assert (again.status, again.attempt, again.requeues) == ("accepted", 2, 1)
    assert len(waits) == 3


# a job in its child


def refuse(monkeypatch: pytest.MonkeyPatch, context: Context, name: str, count: int) -> None:
    """Have a store's method refuse the first ``count`` times."""
    store = context.records
    real: Callable[..., Any] = getattr(store, name)
    refusals = Refusals(count)

    def refusing(*arguments: Any, **changes: Any) -> Any:
        refusals()
        return real(*arguments, **changes)

    monkeypatch.setattr(store, name, refusing)


@pytest.fixture
def context(tmp_path: Path) -> Context:
    settings = Settings(state_dir=tmp_path, heartbeat_s=60)
    return Context(settings, InMemoryRecordStore(), InMemoryBlobStore(), InMemoryJobQueue())


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


@pytest.mark.parametrize("name", ["remember", "update_field"])
@pytest.mark.parametrize(("data", "state"), [(b"f", "ready"), (b"raise", "rejected")])
def test_an_import_waits_for_redis_and_rejects_nothing_for_it(
    context: Context, monkeypatch: pytest.MonkeyPatch, waits: list[float], name: str, data: bytes, state: str
) -> None:
    now = context.records.now()
    context.records.create_field(FieldRecord(SHA, "validating", 1, now, now))
    context.blobs.put(f"fields/{SHA}/original", data)
    refuse(monkeypatch, context, name, 2)

    def importer(upload: Path, folder: Path, description: dict[str, Any]) -> dict[str, Any]:
        if upload.read_bytes() == b"raise":
            raise ValueError("no field")
        return tiny_importer(upload, folder, description)

    run_import_attempt(context, SHA, 1, "w", importer)
    field = context.records.get_field(SHA)
    assert field is not None
    assert field.state == state
    assert len(waits) == 2


def test_the_pipeline_of_a_refusing_redis_is_a_real_one(redis: RefusingRedis) -> None:
    """The double stands on this: pipelines go through ``execute``, and what is refused was not sent."""
    pipeline = redis.pipeline()
    assert isinstance(pipeline, Pipeline)
    redis.refuse_at = redis.sent
    pipeline.set("key", 1)
    with pytest.raises(OutOfMemoryError):
        pipeline.execute()
    assert redis.get("key") is None

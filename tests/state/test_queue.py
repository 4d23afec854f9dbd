"""The queue over RQ: ids only, each attempt once, nothing left behind."""

import json

import pytest
from redis import Redis
from rq.executions import Execution
from rq.job import Job
from rq.serializers import JSONSerializer

from regnf_state.queue import IMPORT_QUEUE_NAME, QUEUE_NAME, Work
from regnf_state.redis.queue import JobQueue
from tests.worker.bench import eventually

SHA = "a" * 64


@pytest.fixture
def queue(redis: Redis) -> JobQueue:
    return JobQueue(redis)


def listed(redis: Redis) -> list[bytes]:
    """What workers may take: RQ's lists."""
    return [name for queue in ("regnf-import", "regnf") for name in redis.lrange(f"rq:queue:{queue}", 0, -1)]


def lined(redis: Redis, owner: str = "anonymous") -> list[bytes]:
    """What waits before that."""
    return redis.lrange(f"regnf:queue:line:{owner}", 0, -1)


@pytest.mark.parametrize(
    ("queue_name", "work", "name"),
    [
        (QUEUE_NAME, Work("registration", "j-1", 3), "j-1-3"),
        (IMPORT_QUEUE_NAME, Work("import", SHA, 12), f"import-{SHA}-12"),
        (IMPORT_QUEUE_NAME, Work("import", f"{SHA}_alice-2", 1), f"import-{SHA}_alice-2-1"),
    ],
)
def test_names_tell_job_and_attempt(queue_name: str, work: Work, name: str) -> None:
    assert work.name == name
    assert Work.named(queue_name, name) == work


@pytest.mark.parametrize(
    ("queue_name", "name"),
    [
        (QUEUE_NAME, "j1"),
        (QUEUE_NAME, "j1-0"),
        (QUEUE_NAME, "j1-1\n"),
        (QUEUE_NAME, "../j1-1"),
        (QUEUE_NAME, "j1:1-1"),
        (QUEUE_NAME, ""),
        (QUEUE_NAME, "a" * 101 + "-1"),
        (IMPORT_QUEUE_NAME, "j1-1"),
        (IMPORT_QUEUE_NAME, f"import-{SHA[1:]}-1"),
        (IMPORT_QUEUE_NAME, f"import-{SHA}_Alice-1"),
        (IMPORT_QUEUE_NAME, f"import-{SHA}-01"),
    ],
)
def test_other_names_mean_nothing(queue_name: str, name: str) -> None:
    with pytest.raises(ValueError, match="not a name"):
        Work.named(queue_name, name)


def test_a_job_is_one_id_as_json(redis: Redis, queue: JobQueue) -> None:
    queue.enqueue_registration("j1", 2)
    queue.enqueue_import(SHA)
    assert listed(redis) == [b"j1-2"], "the next in turn, and nothing else"
    assert lined(redis) == [f"import-{SHA}-1".encode()]
    for key, function, argument in (
        ("rq:job:j1-2", "regnf_worker.jobs.run_registration", "j1"),
        (f"rq:job:import-{SHA}-1", "regnf_worker.jobs.run_import", SHA),
    ):
        data = redis.hget(key, "data")
        assert data is not None
        assert json.loads(bytes(data)) == [function, None, [argument], {}]


def test_every_attempt_is_queued_once(redis: Redis, queue: JobQueue) -> None:
    for _ in range(3):
        queue.enqueue_registration("j1", 1)
        queue.enqueue_import(SHA, 2)
    queue.enqueue_registration("j1", 2)
    assert listed(redis) + lined(redis) == [b"j1-1", f"import-{SHA}-2".encode(), b"j1-2"]


def test_what_the_transport_holds(queue: JobQueue) -> None:
    assert not queue.holds_registration("j1", 1)
    assert not queue.holds_import(SHA, 1)
    queue.enqueue_registration("j1", 1)
    queue.enqueue_import(SHA)
    assert queue.holds_registration("j1", 1)
    assert not queue.holds_registration("j1", 11)
    assert queue.holds_import(SHA, 1)


def test_work_in_progress_is_held_while_its_worker_reports(redis: Redis, queue: JobQueue) -> None:
    for job_id in ("j1-1", "j2-1"):
        queue.enqueue_registration(job_id[:2], 1)
        assert redis.lpop("rq:queue:regnf") == job_id.encode()
        with redis.pipeline() as pipeline:
            job = Job.fetch(job_id, connection=redis, serializer=JSONSerializer)
            Execution.create(job, 60, pipeline, worker_name="w")
            pipeline.execute()
    redis.zadd("rq:wip:regnf", dict.fromkeys(redis.zrange("rq:wip:regnf", 0, -1), 1.0))
    assert queue.holds_registration("j1", 1), "whatever its worker's clock says"
    (key,) = redis.keys("rq:execution:j2-1:*")
    redis.pexpire(key, 1)
    eventually(lambda: not redis.exists(key))
    assert not queue.holds_registration("j2", 1), "its worker fell silent"
    assert queue.holds_registration("j1", 1)


def test_an_id_that_fell_between_two_lists_is_queued_anew(redis: Redis, queue: JobQueue) -> None:
    """A worker that dies right after taking an id leaves the job's hash, and the id in no list."""
    queue.enqueue_registration("j1", 1)
    redis.delete("rq:queue:regnf")
    assert not queue.holds_registration("j1", 1)
    queue.enqueue_registration("j1", 1)
    assert listed(redis) == [b"j1-1"]


def test_what_the_previous_release_has_queued_is_worked_off_first(redis: Redis, queue: JobQueue) -> None:
    redis.rpush("rq:queue:regnf", "old-1", "old-2")
    queue.enqueue_registration("j1", 1)
    assert queue.holds_registration("old", 1)
    queue.enqueue_registration("old", 1)
    assert (listed(redis), lined(redis)) == ([b"old-1", b"old-2"], [b"j1-1"])
    redis.lpop("rq:queue:regnf", 2)
    queue.turn()
    assert listed(redis) == [b"j1-1"]


def test_stopping_a_waiting_job_leaves_nothing_of_it(redis: Redis, queue: JobQueue) -> None:
    for name in ("j1", "j2", "j3"):
        queue.enqueue_registration(name, 1)
    for name in ("j1", "j3", "j9"):
        queue.stop(name, 1)
    assert (listed(redis), lined(redis)) == ([b"j2-1"], [])
    assert [*redis.keys("*j1-1*"), *redis.keys("*j3-1*")] == []


def test_live_workers_are_those_that_reported_lately(redis: Redis, queue: JobQueue) -> None:
    assert queue.live_workers() == 0
    redis.sadd("rq:workers:regnf", "rq:worker:a", "rq:worker:b", "rq:worker:c")
    redis.hset("rq:worker:a", "hostname", "h1")
    redis.hset("rq:worker:b", mapping={"hostname": "h2", "death": "2026-01-01"})
    assert queue.live_workers() == 1

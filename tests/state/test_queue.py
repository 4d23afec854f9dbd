"""The queue: ids only, each attempt once, nothing left behind."""

import pytest
from redis import Redis

from regnf_state.queue import Kind, Work
from regnf_state.redis.fair_queue import LISTS
from regnf_state.redis.queue import ForeignWorkError, JobQueue, Taken
from tests.worker.bench import eventually

SHA = "a" * 64


@pytest.fixture
def queue(redis: Redis) -> JobQueue:
    return JobQueue(redis)


def listed(redis: Redis) -> list[bytes]:
    """What workers may take."""
    return [name for key in LISTS.values() for name in redis.lrange(key, 0, -1)]


def lined(redis: Redis, owner: str = "anonymous") -> list[bytes]:
    """What waits before that."""
    return redis.lrange(f"regnf:queue:line:{owner}", 0, -1)


@pytest.mark.parametrize(
    ("kind", "work", "name"),
    [
        ("registration", Work("registration", "j-1", 3), "j-1-3"),
        ("import", Work("import", SHA, 12), f"import-{SHA}-12"),
        ("import", Work("import", f"{SHA}_alice-2", 1), f"import-{SHA}_alice-2-1"),
    ],
)
def test_names_tell_job_and_attempt(kind: Kind, work: Work, name: str) -> None:
    assert work.name == name
    assert Work.named(kind, name) == work


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("registration", "j1"),
        ("registration", "j1-0"),
        ("registration", "j1-1\n"),
        ("registration", "../j1-1"),
        ("registration", "j1:1-1"),
        ("registration", ""),
        ("registration", "a" * 101 + "-1"),
        ("import", "j1-1"),
        ("import", f"import-{SHA[1:]}-1"),
        ("import", f"import-{SHA}_Alice-1"),
        ("import", f"import-{SHA}-01"),
    ],
)
def test_other_names_mean_nothing(kind: Kind, name: str) -> None:
    with pytest.raises(ValueError, match="not a name"):
        Work.named(kind, name)


def test_one_name_lies_ready(redis: Redis, queue: JobQueue) -> None:
    queue.enqueue_registration("j1", 2)
    queue.enqueue_import(SHA)
    assert listed(redis) == [b"j1-2"], "the next in turn, and nothing else"
    assert lined(redis) == [f"import-{SHA}-1".encode()]


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
    for job_id in ("j1", "j2"):
        queue.enqueue_registration(job_id, 1)
        assert queue.pop(0) == Taken("registration", f"{job_id}-1")
        assert not queue.holds_registration(job_id, 1), "a worker that dies right after taking it"
        queue.begin(f"{job_id}-1", "w")
    assert 0 < redis.ttl("regnf:running:j1-1") <= 60
    redis.pexpire("regnf:running:j2-1", 1)
    eventually(lambda: not queue.holds_registration("j2", 1), "its worker fell silent")
    assert queue.holds_registration("j1", 1)
    queue.enqueue_registration("j1", 1)
    assert listed(redis) + lined(redis) == [], "it is not queued beside its run"
    assert queue.goes_on("j2-1", "w")
    assert queue.holds_registration("j2", 1), "whose worker was slow, and reports again"
    queue.stop("j1", 1)
    assert not queue.goes_on("j1-1", "w")
    for job_id in ("j1", "j2"):
        queue.end(f"{job_id}-1")
        assert not queue.holds_registration(job_id, 1)
    assert redis.keys("*j1*") == redis.keys("*j2*") == []


def test_stopping_a_waiting_job_leaves_nothing_of_it(redis: Redis, queue: JobQueue) -> None:
    for name in ("j1", "j2", "j3"):
        queue.enqueue_registration(name, 1)
    for name in ("j1", "j3", "j9"):
        queue.stop(name, 1)
    assert (listed(redis), lined(redis)) == ([b"j2-1"], [])
    assert [*redis.keys("*j1-1*"), *redis.keys("*j3-1*"), *redis.keys("*j9*")] == []


def test_live_workers_are_those_that_reported_lately(redis: Redis, queue: JobQueue) -> None:
    assert queue.live_workers() == 0
    for worker in ("host:a", "host:b", "host:c"):
        queue.report(worker)
    redis.zincrby("regnf:workers", -46, "host:b")
    queue.sign_off("host:c")
    assert (queue.workers(), queue.live_workers()) == (["host:a"], 1)
    queue.report("host:a")
    assert redis.zcard("regnf:workers") == 1, "the silent one is forgotten"


def test_of_what_is_taken_only_a_name_of_ours_is_believed(any_redis: Redis) -> None:
    """With a key only what was signed with it, for this very name and kind."""
    key = "correct horse battery staple"
    any_redis.flushall()
    plain, signed, forged = (
        JobQueue(any_redis),
        JobQueue(any_redis, key),
        JobQueue(any_redis, "another key, long enough"),
    )
    for number, (queue, reader, why) in enumerate(
        [(plain, plain, None), (signed, signed, None), (plain, signed, "not signed"), (forged, signed, "not signed")]
    ):
        queue.enqueue_registration(f"j{number}", 1)
        taken = reader.pop(0)
        assert taken is not None
        if why is None:
            assert reader.work_of(taken) == Work("registration", f"j{number}", 1)
        else:
            with pytest.raises(ForeignWorkError, match=why):
                reader.work_of(taken)
    signed.enqueue_registration("a", 1)
    stolen = any_redis.hget("regnf:queue:entry:a-1", "signature")
    for name in ("b-1", "a-2"):
        any_redis.hset(f"regnf:queue:entry:{name}", "signature", stolen)
        with pytest.raises(ForeignWorkError, match="not signed"):
            signed.work_of(Taken("registration", name))
    any_redis.set("regnf:queue:entry:c-1", "no hash")
    for name, why in (("c-1", "not a hash"), ("../c-1", "not a name"), ("\\xff", "not a name"), ("c", "not a name")):
        with pytest.raises(ForeignWorkError, match=why):
            plain.work_of(Taken("registration", name))
    assert plain.work_of(Taken("registration", "unknown-1")) is None, "it was stopped meanwhile"

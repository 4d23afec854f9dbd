"""Whoever can write to Redis has no worker run anything: neither functions nor callbacks nor orders of theirs."""

from __future__ import annotations

import json
import pickle
import signal
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from redis import Redis
from rq import Callback, Queue, Repeat, Retry
from rq.command import send_command
from rq.job import Job
from rq.serializers import JSONSerializer

from tests.worker.bench import Bench, bench, eventually, kill

MARK = "tests.worker.intruder.leave_mark"
OURS = "regnf_worker.jobs.run_registration"
IMPORT = f"import-{'c' * 64}-1"
Attack = Callable[[Redis], None]


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path, shutdown_grace_s=0) as made:
        made.add_ready_fields()
        yield made


def queued(function: str = OURS, *arguments: Any, queue: str = "regnf", **options: Any) -> Attack:
    """A job as RQ itself puts it into the list."""

    def attack(redis: Redis) -> None:
        chosen = {"job_id": "evil-1", "result_ttl": 0, "failure_ttl": 60} | options
        Queue(queue, connection=redis, serializer=JSONSerializer).enqueue(function, *(arguments or ["evil"]), **chosen)
        key = f"rq:job:{chosen['job_id']}"
        redis.hset(key, "data", zlib.decompress(redis.hget(key, "data")))  # as the service writes it

    return attack


def altered(**fields: Any) -> Attack:
    """A job that reads as one of ours but for some members of its hash."""

    def attack(redis: Redis) -> None:
        queued(job_timeout=86400, description=f"{OURS} evil-1")(redis)
        redis.hset("rq:job:evil-1", mapping=fields)

    return attack


def raw(data: bytes) -> Attack:
    return altered(data=data)


def of_another_kind(redis: Redis) -> None:
    redis.set("rq:job:evil-1", "no hash")
    redis.rpush("rq:queue:regnf", "evil-1")


def no_text(redis: Redis) -> None:
    redis.hset(b"rq:job:\xff\xfe", mapping={"data": "x"})
    redis.rpush("rq:queue:regnf", b"\xff\xfe")


CALLED = json.dumps([OURS, None, ["evil"], {}]).encode()
ATTACKS: dict[str, Attack] = {
    "another function": queued(MARK),
    "a function of the system": queued("os.mkdir", "/dev/null/x"),
    "another function as an import": queued(MARK, queue="regnf-import", job_id=IMPORT),
    "our function's name in another case": queued(OURS.upper()),
    "another function of our module": queued("regnf_worker.jobs.Settings"),
    "more arguments": queued(OURS, "evil", "more"),
    "named arguments": queued(more=1),
    "another argument than its name says": queued(OURS, "other"),
    "an import's function in the other queue": queued("regnf_worker.jobs.run_import", "c" * 64),
    "a path as an argument": queued(OURS, "../../etc", job_id="evil-1"),
    "no attempt in its name": queued(OURS, "evil", job_id="evil"),
    "a callback on success": queued(on_success=Callback(MARK)),
    "a callback on failure": queued(on_failure=Callback(MARK)),
    "a callback on being stopped": queued(on_stopped=Callback(MARK)),
    "a callback written in": altered(failure_callback_name=MARK),
    "a retry": queued(retry=Retry(3)),
    "a repetition": queued(repeat=Repeat(3)),
    "metadata": queued(meta={"a": 1}),
    "metadata that is pickled": altered(meta=pickle.dumps({"a": 1})),
    "a result that is pickled": altered(result=pickle.dumps(1)),
    "another time limit": queued(job_timeout=10**9),
    "a time limit that is no number": altered(timeout="x"),
    "no time limit": altered(timeout="-1"),
    "a group": altered(group_id="g"),
    "a dependency": altered(dependency_ids='["evil-2"]'),
    "an address to call": altered(webhooks=json.dumps([{"url": "http://127.0.0.1:9/", "job_status": "failed"}])),
    "another queue as its origin": altered(origin="other"),
    "a member that nobody knows": altered(unknown="1"),
    "pickled data": raw(pickle.dumps((OURS, None, ("evil",), {}))),
    "data that is no JSON": raw(b"{"),
    "data that is deeply nested": raw(zlib.compress(b"[" * 100_000)),
    "data that grows a thousandfold": raw(zlib.compress(CALLED + b" " * 10_000_000)),
    "an instance": raw(json.dumps(["run", {"a": 1}, ["evil"], {}]).encode()),
    "no data": lambda redis: (queued()(redis), redis.hdel("rq:job:evil-1", "data"))[0],
    "no hash": of_another_kind,
    "a name that is no text": no_text,
}


def refusals(redis: Redis) -> int:
    counted: dict[bytes, bytes] = redis.hgetall("regnf:counters")
    return sum(int(value) for name, value in counted.items() if b"refused" in name)


def test_what_is_put_into_the_queue_by_hand_never_runs(table: Bench) -> None:
    worker = table.start_worker()
    for number, (name, attack) in enumerate(ATTACKS.items(), 1):
        kill(worker.pid, signal.SIGSTOP)  # an attack puts a name into the list, then changes the hash
        attack(table.redis)
        kill(worker.pid, signal.SIGCONT)
        eventually(lambda number=number: refusals(table.redis) == number, name)
        assert not table.redis.keys("rq:job:*"), f"{name} is forgotten before it is counted"
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    assert worker.poll() is None, table.log()
    assert not (table.context.settings.state_dir / "mark").exists(), "it ran"
    assert refusals(table.redis) == len(ATTACKS), table.log()
    assert "is not run and removed" in table.log()
    assert "another process" not in table.log()


def test_a_callback_of_work_that_seems_abandoned_does_not_run(table: Bench) -> None:
    """RQ's own sweep, in the worker itself, would import it and call it."""
    queued(on_failure=Callback(MARK))(table.redis)
    table.redis.delete("rq:queue:regnf")
    table.redis.zadd("rq:wip:regnf", {"evil-1:e": 1.0})
    worker = table.start_worker()
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    assert worker.poll() is None
    assert not (table.context.settings.state_dir / "mark").exists(), "it ran"
    assert table.redis.zscore("rq:wip:regnf", "evil-1:e") is None


def test_dependents_of_a_job_are_not_queued(table: Bench) -> None:
    queue = Queue("other", connection=table.redis, serializer=JSONSerializer)
    Job.create(MARK, id="evil-1", origin="other", connection=table.redis, serializer=JSONSerializer).save()
    table.redis.sadd("rq:job:next-1:dependents", "evil-1")
    table.start_worker()
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    eventually(lambda: not table.redis.exists("rq:job:next-1"), "the queue's forgetting the job")
    assert queue.job_ids == []


@pytest.mark.parametrize(
    "command",
    [
        ("shutdown", {}),
        ("kill-horse", {}),
        ("stop-job", {"job_id": "other-1"}),
        ("stop-job", {"job_id": ["next-1"]}),
        ("stop-job", {}),
        ("unknown", {}),
    ],
    ids=str,
)
def test_orders_over_redis_end_neither_workers_nor_other_jobs(table: Bench, command: tuple[str, Any]) -> None:
    worker = table.start_worker()
    table.submit("wait_for_file", "next")
    table.reaches("sampling", "next")
    (key,) = table.redis.smembers("rq:workers:regnf")
    name = key.decode().removeprefix("rq:worker:")
    table.redis.publish(f"rq:pubsub:{name}", b"\xff{")
    send_command(table.redis, name, command[0], **command[1])
    eventually(lambda: table.log().count("is ignored") == 2, table.log)
    assert table.job("next").status == "running"
    assert worker.poll() is None
    table.context.records.request_cancel("next")
    table.context.queue.stop("next", 1)
    assert table.finished("next").status == "dismissed"


def test_with_a_key_only_what_is_signed_runs(tmp_path: Path) -> None:
    from regnf_state.queue import Work
    from regnf_state.redis.queue import SIGNATURE, JobQueue, signature

    key = "correct horse battery staple"
    with bench(tmp_path, queue_key=key) as table:
        table.add_ready_fields()
        signed, forged = JobQueue(table.redis, key), JobQueue(table.redis, "another key, long enough")
        table.submit("succeed", "unsigned")
        for name, queue in (("forged", forged), ("signed", signed)):
            table.submit("succeed", name)
            table.context.queue.stop(name, 1)
            queue.enqueue_registration(name, 1)
        table.submit("succeed", "borrowed")
        table.redis.hset("rq:job:borrowed-1", SIGNATURE, signature(Work("registration", "signed", 1), key))
        table.submit("succeed", "last")
        table.context.queue.stop("last", 1)
        signed.enqueue_registration("last", 1)
        table.start_worker()
        assert table.finished("last").status == "successful"
        assert table.job("signed").status == "successful"
        assert {table.job(name).status for name in ("unsigned", "forged", "borrowed")} == {"accepted"}
        assert table.redis.hget("regnf:counters", "queue_payloads_refused|regnf") == b"3"
        assert key not in table.log()


@pytest.mark.parametrize("document", ["{", "[]", json.dumps({"attempt": "x"})])
def test_a_damaged_record_does_not_end_the_worker_that_takes_its_job(table: Bench, document: str) -> None:
    table.submit("succeed", "damaged")
    table.redis.hset("regnf:job:damaged", "document", document)
    table.redis.delete("regnf:counters")
    table.redis.set("regnf:counters", "no counters either")
    worker = table.start_worker()
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    assert worker.poll() is None, table.log()

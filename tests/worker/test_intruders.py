"""Whoever can write to Redis has no worker run anything but the service's own work, and ends no worker."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from regnf_state.redis.queue import JobQueue
from tests.worker.bench import Bench, bench

ODD = (
    b"os.mkdir",
    b"",
    b"evil",
    b"evil-0",
    b"../../etc-1",
    b"evil-1\n",
    b"\xff\xfe",
    b"x" * 300,
    b"import-" + b"c" * 63,
)
"""Names that no work has."""


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path, shutdown_grace_s=0) as made:
        made.add_ready_fields()
        yield made


@pytest.mark.parametrize("kind", ["registration", "import"])
def test_what_is_put_into_the_queue_by_hand_never_runs(table: Bench, kind: str) -> None:
    for name in ODD:
        table.redis.rpush(f"regnf:queue:ready:{kind}", name)
        table.redis.hset(b"regnf:queue:entry:" + name, mapping={"owner": "x", "kind": kind, "signature": ""})
    table.redis.set("regnf:queue:entry:evil-1", "no hash")
    table.redis.rpush("regnf:queue:ready:registration", "evil-1")
    worker = table.start_worker()
    table.submit("succeed", "next")
    assert table.finished("next").status == "successful"
    assert worker.poll() is None, table.log()
    counted = {name: value for name, value in table.redis.hgetall("regnf:counters").items() if b"refused" in name}
    assert sum(map(int, counted.values())) == table.log().count("is not run and removed") == len(ODD) + 1
    assert "another process" not in table.log()


def test_an_order_to_stop_other_work_ends_nothing(table: Bench) -> None:
    worker = table.start_worker()
    table.submit("wait_for_file", "next")
    table.reaches("sampling", "next")
    for name in ("other", "next-1", ""):
        table.context.queue.stop(name, 1)
    assert table.job("next").status == "running"
    (table.context.settings.state_dir / "go").write_bytes(b"")
    assert table.finished("next").status == "successful"
    assert worker.poll() is None


def test_with_a_key_only_what_is_signed_runs(tmp_path: Path) -> None:
    key = "correct horse battery staple"
    with bench(tmp_path, queue_key=key) as table:
        table.add_ready_fields()
        signed, forged = JobQueue(table.redis, key), JobQueue(table.redis, "another key, long enough")
        for name, queue in (
            ("unsigned", JobQueue(table.redis)),
            ("forged", forged),
            ("signed", signed),
            ("last", signed),
        ):
            table.submit("succeed", name)
            table.context.queue.stop(name, 1)
            queue.enqueue_registration(name, 1)
        table.start_worker()
        assert table.finished("last").status == "successful"
        assert table.job("signed").status == "successful"
        assert {table.job(name).status for name in ("unsigned", "forged")} == {"accepted"}
        assert table.redis.hget("regnf:counters", "queue_payloads_refused|registration") == b"2"
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

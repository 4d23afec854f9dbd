"""Real workers of two callers: one worker stays free for the caller who has been here, whoever is killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.processes import children_of
from tests.worker.bench import Bench, bench, eventually

CALLERS = ("greedy", "honest")
GREEDY = [f"greedy-{number}" for number in range(4)]


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path) as made:
        for caller in CALLERS:
            made.add_ready_fields(caller)
        yield made


def runs(table: Bench, job_id: str, owner: str) -> None:
    table.submit("succeed", job_id, owner)
    assert table.finished(job_id).status == "successful"


def begin(table: Bench, owner: str, jobs: list[str]) -> None:
    """Jobs that go on until ``let_all_end``."""
    for job in jobs:
        table.submit("wait_for_file", job, owner)


def under_way(table: Bench, count: int) -> set[str]:
    """The jobs that are being run, once they are so many."""

    def look() -> set[str]:
        return {job.id for job in table.context.records.active_jobs() if job.phase == "sampling"}

    return eventually(lambda: found if len(found := look()) == count else set(), lambda: f"{count}, not {look()}")


def let_all_end(table: Bench, jobs: list[str]) -> None:
    (table.context.settings.state_dir / "go").write_bytes(b"")
    assert {table.finished(job).status for job in jobs} == {"successful"}


def test_a_worker_is_free_for_the_caller_who_comes_back(table: Bench) -> None:
    for _ in range(2):
        table.start_worker()
    runs(table, "honest-1", "honest")
    begin(table, "greedy", GREEDY)
    under_way(table, 1)
    for job in ("honest-2", "honest-3"):
        runs(table, job, "honest")
        assert under_way(table, 1) == {"greedy-0"}
    let_all_end(table, GREEDY)


def test_a_caller_alone_has_both_workers(table: Bench) -> None:
    for _ in range(2):
        table.start_worker()
    begin(table, "greedy", GREEDY)
    assert under_way(table, 2) == {"greedy-0", "greedy-1"}
    let_all_end(table, GREEDY)


def test_a_killed_worker_holds_nothing_once_its_report_has_expired(table: Bench) -> None:
    worker = table.start_worker()
    runs(table, "honest-1", "honest")
    begin(table, "greedy", GREEDY)
    under_way(table, 1)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    for _ in range(2):
        table.start_worker()
    runs(table, "honest-2", "honest")
    expire_reports(table)
    assert under_way(table, 2) == {"greedy-0", "greedy-1"}, (
        "the record of the first says so until the reaper has looked"
    )
    runs(table, "honest-3", "honest")
    let_all_end(table, GREEDY[1:])


def expire_reports(table: Bench) -> None:
    """What Redis would have dropped by now of the killed worker: what live ones reported, they report again."""
    for key in table.redis.scan_iter("rq:execution*"):
        table.redis.delete(key)
    name: Any = table.job("greedy-0").worker
    table.redis.delete(f"rq:worker:{name}")
    table.redis.hincrbyfloat("regnf:queue:entry:greedy-0-1", "taken", -60.0)


def test_the_processes_of_a_caller_above_its_share_give_way(table: Bench) -> None:
    """What has run most in the last minutes has the lower priority, and the same results."""
    worker = table.start_worker()
    runs(table, "honest-1", "honest")
    found = {}
    for caller in CALLERS:
        has_used(table, caller, 500.0 if caller == "greedy" else 1.0)
        begin(table, caller, [f"{caller}-held"])
        table.reaches("sampling", f"{caller}-held")
        (child,) = children_of(worker.pid)
        found[caller] = os.getpriority(os.PRIO_PROCESS, child)
        let_all_end(table, [f"{caller}-held"])
        (table.context.settings.state_dir / "go").unlink()
    assert found["honest"] == os.getpriority(os.PRIO_PROCESS, worker.pid)
    assert 5 <= found["greedy"] - found["honest"] <= 10
    greedy, honest = (artifact(table, f"{caller}-held") for caller in CALLERS)
    assert greedy == honest


def has_used(table: Bench, caller: str, seconds: float) -> None:
    """Worker seconds in this minute."""
    minute = int(table.context.records.now()) // 60
    table.redis.hincrbyfloat(f"regnf:queue:spent:{caller}", str(minute), seconds)


def artifact(table: Bench, job_id: str) -> bytes:
    with table.context.blobs.open(f"jobs/{job_id}/1/aligned.ply") as file:
        return file.read()


@pytest.mark.parametrize(("niceness", "others"), [(0, True), (10, False)])
def test_nobody_gives_way_where_it_is_switched_off_or_nobody_else_is_there(
    table: Bench, niceness: int, others: bool
) -> None:
    worker = table.start_worker(job_niceness=niceness)
    if others:
        runs(table, "honest-1", "honest")
    for number in range(2):
        runs(table, f"greedy-before-{number}", "greedy")
    begin(table, "greedy", ["greedy-held"])
    table.reaches("sampling", "greedy-held")
    (child,) = children_of(worker.pid)
    assert os.getpriority(os.PRIO_PROCESS, child) == os.getpriority(os.PRIO_PROCESS, worker.pid)
    let_all_end(table, ["greedy-held"])

"""What one job may use of memory and disk space, and how it ends beyond that."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from regnf_state.settings import MIB, Settings
from regnf_worker.job_limits import JobLimits, folder_bytes, granted_memory, private_bytes
from tests.worker.bench import Bench, bench
from tests.worker.test_worker import assert_next_job_runs

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux limits and counts the memory")
LIMITS = {"job_memory_bytes": 512 * MIB, "job_scratch_bytes": 64 * MIB}


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path, **LIMITS) as made:
        made.add_ready_fields()
        yield made


@pytest.mark.parametrize(
    ("do", "reason", "limit"),
    [
        ("fill_memory", "OUT_OF_MEMORY", "job_memory_bytes"),
        ("fill_shared_memory", "OUT_OF_MEMORY", "job_memory_bytes"),
        ("fill_memory_and_abort", "OUT_OF_MEMORY", "job_memory_bytes"),
        ("fill_disk", "JOB_DISK_LIMIT", "job_scratch_bytes"),
        ("write_one_large_file", "JOB_DISK_LIMIT", "job_scratch_bytes"),
    ],
)
def test_a_job_over_a_limit_ends_and_its_worker_goes_on(table: Bench, do: str, reason: str, limit: str) -> None:
    worker = table.start_worker()
    table.submit(do)
    done = table.finished()
    assert done.error is not None
    assert (done.status, done.error["reason"], done.error["status"]) == ("failed", reason, 500)
    assert done.error["limit_bytes"] == LIMITS[limit]
    assert "REGNF_" + limit.upper() in done.error["hint"]
    assert done.attempt == 1, "it would end the same way again"
    assert_next_job_runs(table)
    assert worker.poll() is None


def test_an_abort_far_from_the_limit_is_no_matter_of_memory(table: Bench) -> None:
    table.start_worker()
    table.submit("abort")
    error = table.finished().error
    assert error is not None
    assert error["reason"] == "WORKER_LOST"


def test_a_job_that_redis_failed_near_the_limit_is_run_again(table: Bench) -> None:
    table.start_worker()
    table.submit("lose_redis_near_the_limit")
    done = table.finished()
    assert (done.status, done.attempt) == ("successful", 2), done.error


def test_a_limit_that_is_given_holds_whatever_there_is() -> None:
    assert JobLimits.of(Settings(job_memory_bytes=700 * MIB, workers=64)).memory == 700 * MIB


def test_without_a_limit_workers_share_three_quarters_of_what_is_granted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("regnf_worker.job_limits.granted_memory", lambda: 16 << 30)
    assert JobLimits.of(Settings(workers=3)).memory == 4 << 30
    assert JobLimits.of(Settings(workers=64)).memory == 1 << 30, "an engine that cannot even start is of no use"


def test_a_control_group_and_those_around_it_limit_what_is_granted(tmp_path: Path) -> None:
    own, groups = tmp_path / "own", tmp_path / "groups"
    own.write_text("0::/service/worker\n")
    (groups / "service" / "worker").mkdir(parents=True)
    machine = granted_memory(own, groups)
    (groups / "service" / "worker" / "memory.max").write_text("max\n")
    assert granted_memory(own, groups) == machine
    (groups / "service" / "memory.max").write_text(f"{64 * MIB}\n")
    assert granted_memory(own, groups) == 64 * MIB


def test_memory_that_is_shared_with_a_fork_is_not_private() -> None:
    held = bytearray(os.urandom(1 << 16)) * (64 * MIB >> 16)
    before = private_bytes(os.getpid())
    go, end = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        os.write(go[1], b".")
        os.read(end[0], 1)
        os._exit(0)
    os.read(go[0], 1)
    try:
        assert before > len(held)
        assert private_bytes(child) < len(held) / 2
    finally:
        os.write(end[1], b".")
        os.waitpid(child, 0)


def test_a_folder_is_as_large_as_its_files(tmp_path: Path) -> None:
    assert folder_bytes(tmp_path) == 0
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "file").write_bytes(os.urandom(MIB))
    assert folder_bytes(tmp_path) >= MIB
    assert folder_bytes(tmp_path / "gone") == 0


def test_a_folder_that_goes_while_it_is_looked_at_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job removes its folders while the worker measures them: that must not end the worker."""
    (tmp_path / "stays").write_bytes(os.urandom(MIB))
    (tmp_path / "goes" / "deeper").mkdir(parents=True)
    look = os.scandir

    def too_late(folder: str | Path) -> object:
        if Path(folder).name == "goes":
            (tmp_path / "goes" / "deeper").rmdir()
            (tmp_path / "goes").rmdir()
        return look(folder)

    monkeypatch.setattr(os, "scandir", too_late)
    assert MIB <= folder_bytes(tmp_path) < 2 * MIB
    assert not (tmp_path / "goes").exists()

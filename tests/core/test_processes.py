"""Work done by forked copies of this process."""

from __future__ import annotations

import gc
import os
import platform
import resource
import select
import signal
from collections.abc import Iterator
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest
import torch

from regnf_core.errors import CancelledError, NoSurfaceError
from regnf_core.processes import ProcessLostError, can_fork, in_processes, keep_freed_memory

pytestmark = pytest.mark.skipif(not can_fork(), reason="this system cannot copy a process")


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    yield
    gc.collect()
    assert not active_children()


def _new_pages(task: int) -> int:
    """Pages that arrays of 8 MB cost, one after another."""
    if task:
        keep_freed_memory()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(1 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_memory_is_used_again() -> None:
    (kept,) = in_processes(_new_pages, [1], 2)
    assert kept < 2 * (8 << 20) // resource.getpagesize()


def test_results_come_in_the_order_of_their_tasks() -> None:
    held = torch.arange(100.0)  # seen by the copies without being sent
    done = list(in_processes(lambda task: (task, os.getpid(), float(held[task])), range(40), 3))
    assert [task for task, _, _ in done] == list(range(40))
    assert [value for _, _, value in done] == list(range(40))
    processes = {process for _, process, _ in done}
    assert os.getpid() not in processes
    assert 1 < len(processes) <= 3


def test_no_task_and_fewer_tasks_than_processes() -> None:
    assert list(in_processes(lambda task: task, [], 4)) == []
    assert len(set(in_processes(lambda task: os.getpid(), [1, 2], 4))) <= 2


def test_copies_use_one_thread() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    held = torch.ones(300, 300)
    assert float((held @ held).sum()) == 300**3
    counts = list(in_processes(lambda _: (torch.get_num_threads(), float((held @ held).sum())), [0, 1], 2))
    assert counts == [(1, 300.0**3), (1, 300.0**3)]
    assert torch.get_num_threads() == 3
    torch.set_num_threads(before)


def test_an_error_is_raised_here_with_its_reason() -> None:
    def fail(task: int) -> int:
        if task == 3:
            raise NoSurfaceError("nothing", reason="NO_SURFACE_IN_SCENE", hint="look elsewhere")
        return task

    with pytest.raises(NoSurfaceError) as caught:
        list(in_processes(fail, range(10), 2))
    assert (caught.value.reason, caught.value.hint, str(caught.value)) == (
        "NO_SURFACE_IN_SCENE", "look elsewhere", "nothing",
    )  # fmt: skip


def test_an_error_of_a_library_says_where_it_came_from() -> None:
    def fail(_: int) -> int:
        raise KeyError("absent")

    with pytest.raises(RuntimeError, match="KeyError: 'absent'"):
        list(in_processes(fail, [1, 2], 2))


def test_a_killed_process_is_no_endless_wait() -> None:
    def die(task: int) -> int:
        if task == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return task

    with pytest.raises(ProcessLostError) as caught:
        list(in_processes(die, range(6), 2))
    assert caught.value.reason == "WORKER_LOST"


def test_what_watches_may_end_the_work_while_a_result_is_waited_for(tmp_path: Path) -> None:
    begun = tmp_path / "begun"

    def never(_: int) -> None:
        begun.touch()
        signal.pause()

    def watch() -> None:
        if begun.exists():
            raise CancelledError("enough")

    with pytest.raises(CancelledError):
        list(in_processes(never, [1, 2], 2, watch))


def test_who_leaves_early_leaves_no_process() -> None:
    done = in_processes(lambda task: task, range(100), 2)
    assert next(done) == 0
    assert len(active_children()) == 2
    done.close()
    assert not active_children()


def test_copies_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    written = tmp_path / "copy"

    def never(_: int) -> None:
        written.write_text(str(os.getpid()))
        os.rename(written, tmp_path / "pid")
        signal.pause()

    child = os.fork()
    if child == 0:
        list(in_processes(never, [1], 1))
        os._exit(0)
    while not (tmp_path / "pid").exists():
        assert os.waitpid(child, os.WNOHANG)[0] == 0
    copy = int((tmp_path / "pid").read_text())
    watched = os.pidfd_open(copy)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert select.select([watched], [], [], 30)[0]
    os.close(watched)

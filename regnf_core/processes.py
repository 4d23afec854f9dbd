"""Copies of this process that work beside it: forked, so that they see its memory and load nothing again."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from regnf_core.errors import RegnfError

# A process that does not outlive its parent, and the memory that there is.

_PR_SET_PDEATHSIG = 1


def die_with_parent(parent_pid: int) -> None:
    """Have the kernel kill this process when its parent ends, however it ends (Linux; nothing elsewhere).

    Call it in a fresh child that the parent's main thread forked: the kernel watches that thread.
    """
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent_pid:  # the parent died before this call
        os.kill(os.getpid(), signal.SIGKILL)


_MALLOPT = (-1, 1 << 26), (-3, 1 << 24)
"""M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt, bytes."""


def keep_freed_memory() -> None:
    """Have the C library keep some freed memory for what is allocated next (glibc; nothing elsewhere).

    Else each larger array is given back to the system, and the next one's pages are made again, one by one.
    """
    with suppress(OSError, AttributeError):
        for parameter, size in _MALLOPT:
            ctypes.CDLL(None).mallopt(parameter, size)


def memory_of_the_machine() -> int:
    """All of it, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


Task = TypeVar("Task")
Done = TypeVar("Done")
_AHEAD = 3
"""Tasks for each process that are begun before the result that is waited for is there."""
_WAIT_S = 0.25
"""How long a result is waited for at most before ``watch`` is called again."""


class ProcessLostError(RegnfError):
    """A process that worked for this one was ended from outside, often for want of memory."""

    reason = "WORKER_LOST"


def can_fork() -> bool:
    """Whether this system can copy a process."""
    return sys.platform.startswith("linux")


def in_processes(
    work: Callable[[Task], Done], tasks: Sequence[Task], processes: int, watch: Callable[[], None] = lambda: None
) -> Generator[Done, None, None]:
    """``work`` of each task, in their order, done by forked copies of this process.

    Tasks and results are pickled; ``work`` is not, and sees what this process has in memory. ``watch`` is called again
    and again while a result is waited for. What it or ``work`` raises is raised here, and ends all copies; so does
    closing the generator. Copies use one thread each. Raises ProcessLostError: a copy was killed.
    """
    context = multiprocessing.get_context("fork")
    copies: list[_Copy] = []
    try:
        copies += [_Copy(context, work) for _ in range(min(processes, len(tasks)))]
        yield from _in_order(copies, tasks, watch)
    finally:
        for copy in copies:
            copy.end()


def _in_order(copies: Sequence[_Copy], tasks: Sequence[Any], watch: Callable[[], None]) -> Iterator[Any]:
    idle, begun = list(copies), 0
    done: dict[int, Any] = {}
    for number in range(len(tasks)):
        while number not in done:
            watch()
            while idle and begun < min(len(tasks), number + _AHEAD * len(copies)):
                idle.pop().begin(begun, tasks[begun])
                begun += 1
            busy = {copy.connection: copy for copy in copies if copy not in idle}
            for ready in wait(list(busy), _WAIT_S):
                copy = busy[ready]
                done[copy.task] = copy.result()
                idle.append(copy)
        yield done.pop(number)


class _Copy:
    """One forked process, and the pipe to it. task: the number of the one that it was given last."""

    def __init__(self, context: Any, work: Callable[[Any], Any]) -> None:
        self.task = -1
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, work, os.getpid()), daemon=True)
        self._process.start()
        theirs.close()  # so that no copy but this one holds its end: reading tells when it has died

    def begin(self, number: int, task: Any) -> None:
        self.task = number
        with suppress(OSError):  # it has died: reading says so
            self.connection.send(task)

    def result(self) -> Any:
        try:
            done, value = self.connection.recv()
        except (EOFError, OSError) as error:
            raise ProcessLostError("a process was killed from outside", hint="Is there enough memory?") from error
        if not done:
            raise value
        return value

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self._process.close()
        self.connection.close()


def _serve(connection: Connection, work: Callable[[Any], Any], parent_pid: int) -> None:
    """A copy's life: the parent ends it."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too, which ends this process
    die_with_parent(parent_pid)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)  # threads of the parent are not here: what waits for them waits for ever
    while True:
        task = connection.recv()
        try:
            answer = True, work(task)
        except Exception as error:  # noqa: BLE001 -- raised again by the parent
            answer = False, _sendable(error)
        connection.send(answer)


def _sendable(error: Exception) -> Exception:
    """The error, if it can surely be pickled, else one with its traceback as the message."""
    if isinstance(error, RegnfError | MemoryError):
        return error
    return RuntimeError("in another process:\n" + "".join(traceback.format_exception(error)))

"""What the worker asks of the operating system: to share cores, to give way.

It also reports kills for memory.
"""

from __future__ import annotations

import logging
import os
import select
import time
from collections.abc import Callable, MutableMapping
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from regnf_core.parent_process import die_with_parent

RAISED = 70
"""Status of a forked process that ended with an exception: Redis or storage was away. Native code ends with others."""
_OOM_SCORE = "500"
_EXIT_POLL_S = 0.005
_COUNTERS = ("/proc/vmstat", "/sys/fs/cgroup/memory.events", "/sys/fs/cgroup/memory/memory.oom_control")
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
logger = logging.getLogger(__name__)


class Exit(NamedTuple):
    """The end of a child. ``status`` as waitpid has it; None when other code has waited for the child. ``peak_memory``:
    the most that was resident, bytes."""

    status: int | None
    peak_memory: int = 0


def wait_for_exit(child: int, ended: int, seconds: float) -> Exit | Literal["spoken"] | None:
    """Wait for a child to end or to say something, for so many seconds at most; None when it still runs.

    ``ended`` is the reading end of a pipe whose writing end only the child holds open.
    """
    deadline = time.monotonic() + seconds
    if select.select([ended], [], [], seconds)[0] and os.read(ended, 1):
        return "spoken"
    while True:
        try:
            pid, status, usage = os.wait4(child, os.WNOHANG)
        except ChildProcessError:
            return Exit(None)
        if pid:
            return Exit(status, usage.ru_maxrss * 1024)
        if time.monotonic() >= deadline:
            return None
        time.sleep(_EXIT_POLL_S)  # the kernel closes a process' files a moment before it can be waited for


def forked(work: Callable[[], object]) -> int:
    """Do something in a copy of this process, which ends with it; the copy's process id. Raises OSError: none was made.

    The copy always ends here, with status 0 or ``RAISED``. Nothing of what it inherited runs in it: no ``finally`` and
    no ``except`` of its parent's, which would clear away what the parent still needs.
    """
    parent = os.getpid()
    status = RAISED
    try:
        child = os.fork()
        if child:
            return child
        die_with_parent(parent)
        work()
        status = 0
    except BaseException:  # also a handler of signals that raises, as RQ's does, before ``work`` has set its own
        if os.getpid() == parent:
            raise
        logger.exception("a forked process ends")
    finally:
        if os.getpid() != parent:
            os._exit(status)
    raise AssertionError("a forked process goes on")


def in_child(work: Callable[[], object]) -> bool:
    """Do something in a forked process and wait for it. Whether it came to its end; False where none could be made."""
    try:
        child = forked(work)
    except OSError as error:
        logger.error("no process could be made: %s", error)
        return False
    return os.waitpid(child, 0)[1] == 0


def prefer_as_oom_victim() -> None:
    """When memory runs out, the kernel kills this process first, not the worker or Redis."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(_OOM_SCORE)


def give_way(niceness: int) -> None:
    """Have the kernel prefer other processes to this one and its children, where both want a core.

    Linux may schedule each session as a group of its own: the leader of one gives way with its whole group.
    """
    with suppress(OSError):
        reached = os.nice(niceness)
        if os.getsid(0) == os.getpid():
            Path("/proc/self/autogroup").write_text(str(reached))


def oom_kills() -> int:
    """How many processes the kernel has killed for memory, here or in this container; only its growth has meaning."""
    total = 0
    for counter in _COUNTERS:
        with suppress(OSError):
            for line in Path(counter).read_text().splitlines():
                name, _, value = line.partition(" ")
                total += int(value) if name == "oom_kill" else 0
    return total


def share_cores(environment: MutableMapping[str, str], threads: int | None, workers: int) -> None:
    """Set how many threads each job's libraries start, before any of them is loaded. What the user set stays.

    Threads wait passively: spinning ones of two jobs on the same cores slow each other many times over.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = threads if threads is not None else max(1, cores // max(1, workers))
    for name in _THREAD_VARIABLES:
        if threads is not None:
            environment[name] = str(count)
        else:
            environment.setdefault(name, str(count))
    environment.setdefault("OMP_WAIT_POLICY", "PASSIVE")

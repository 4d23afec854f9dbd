"""What the worker asks of the operating system: to share cores, to give way.

It also reports kills for memory.
"""

from __future__ import annotations

import fcntl
import logging
import os
import select
import shutil
import signal
import time
from collections.abc import Callable, MutableMapping
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple
from uuid import uuid4

from regnf_core.processes import die_with_parent

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

    ``ended`` is one end of a pair of sockets, or of a pipe; only the child holds the other end open.
    """
    deadline = time.monotonic() + seconds
    if select.select([ended], [], [], seconds)[0]:
        with suppress(ConnectionResetError):  # it has died before it read what it was told
            if os.read(ended, 1):
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
    except BaseException:  # also a handler of signals that raises, before ``work`` has set its own
        if os.getpid() == parent:
            raise
        logger.exception("a forked process ends")
    finally:
        if os.getpid() != parent:
            os._exit(status)
    raise AssertionError("a forked process continues")


def in_child(work: Callable[[], object]) -> bool:
    """Do something in a forked process and wait for it. Whether it came to its end; False where none could be made."""
    try:
        child = forked(work)
    except OSError as error:
        logger.error("no process could be started: %s", error)
        return False
    return os.waitpid(child, 0)[1] == 0


def kill_group(pid: int) -> None:
    """End a child and what it has started."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)


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


# A folder for temporary files that is gone when its worker is, however the worker ends.

_LOCK = ".lock"


class Scratch:
    """One worker's folder below ``parent``. Making one sweeps away the folders whose workers have died."""

    def __init__(self, parent: Path) -> None:
        parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with (parent / _LOCK).open("a") as gate:
            fcntl.flock(gate, fcntl.LOCK_EX)  # no other process sweeps while a folder exists that is not yet locked
            for left in parent.iterdir():
                if left.is_dir():
                    _remove_if_dead(left)
            self.folder = parent / uuid4().hex
            self.folder.mkdir(mode=0o700)
            self._lock = (self.folder / _LOCK).open("a")
            fcntl.flock(self._lock, fcntl.LOCK_EX)
        self._left: list[Path] = []

    def of_job(self) -> Path:
        """The name of a folder for one job; ``make`` makes it."""
        return self.folder / f"job-{uuid4().hex}"

    @staticmethod
    def make(folder: Path) -> None:
        """Make a job's folder. Raises OSError: the disk is full, or the volume away."""
        folder.mkdir(mode=0o700)

    def drop(self, folder: Path) -> None:
        """Delete whatever a job has left. What cannot be deleted now goes with ``drop_left``."""
        try:
            shutil.rmtree(folder)
        except FileNotFoundError:
            if not self.folder.exists():  # the volume is away, and comes back with what is on it
                self._left.append(folder)
        except OSError as error:
            logger.warning("temporary files are not deleted yet: %s", error)
            self._left.append(folder)

    def drop_left(self) -> bool:
        """Delete what could not be deleted before, once the folder is there: whether anything is left."""
        if self._left and self.folder.exists():
            left, self._left = self._left, []
            for folder in left:
                shutil.rmtree(folder, ignore_errors=True)
                self._left += [folder] if folder.exists() else []
        return bool(self._left)

    @staticmethod
    def use(folder: Path) -> None:
        """Have this process' temporary files made here."""
        import tempfile

        os.environ["TMPDIR"] = str(folder)
        tempfile.tempdir = str(folder)

    def remove(self) -> None:
        """The worker ends."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock.close()


def _remove_if_dead(folder: Path) -> None:
    with suppress(BlockingIOError, FileNotFoundError), (folder / _LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)

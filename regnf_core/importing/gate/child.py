"""A child process that gets a request, a deadline and little room to talk; whatever it does, this side returns."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Literal

# How long a child has run, without the time for which it was ready to run and others had the cores.

LONGEST = 2.0
"""A child never has longer than so many times its limit, however much others do."""
_NANOSECONDS = 1e9


def waited_s(pid: int) -> float:
    """Seconds for which the process was ready and had no core, by Linux's account of its first thread; 0 without it."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / _NANOSECONDS
    except (OSError, ValueError, IndexError):
        return 0.0


@dataclass(frozen=True)
class FairClock:
    """Tells whether the process has had ``limit_s``. Where a machine has more to do than cores, that takes longer."""

    pid: int
    limit_s: float
    now: Callable[[], float] = time.monotonic
    waited: Callable[[int], float] = waited_s
    started: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "started", self.now())

    def left_s(self) -> float:
        """What is left of the limit, not below 0."""
        since = self.now() - self.started
        had = max(since - self.waited(self.pid), since / LONGEST)
        return max(0.0, self.limit_s - had)


# What the parent sees of a child while it runs: limits that the kernel has for a file or a user, not a child.

MAX_THREADS = 64
MAX_ENTRIES = 64
_BLOCK = 512

Trespass = Literal["threads", "output"]
Watch = Callable[[], Trespass | None]


def trespass_of(pid: int, folder: Path, folder_bytes: int, most: int = MAX_ENTRIES) -> Trespass | None:
    """Which limit the child is beyond, if any: how many threads it has, how much lies in its folder.

    most: entries, those of folders in it included.
    """
    if _threads(pid) > MAX_THREADS:
        return "threads"
    count = total = 0
    waiting = [str(folder)]
    while waiting:
        with suppress(FileNotFoundError), os.scandir(waiting.pop()) as entries:  # a file may just be renamed
            for entry in entries:
                count += 1
                total += entry.stat(follow_symlinks=False).st_blocks * _BLOCK
                if count > most or total > folder_bytes:
                    return "output"
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
    return None


def _threads(pid: int) -> int:
    """Threads of the process, 0 where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[17])


_LOOK_S = 0.1
_MAX_OUTPUT = 64 * 1024
"""Bytes of standard output and of standard error that are kept; a child that says more is ended."""


Stopped = Literal["late", "talkative"] | Trespass


@dataclass(frozen=True)
class ChildOutcome:
    """How the child ended: by ``exit_status`` or by ``signal``, and why this side stopped it, if it did."""

    exit_status: int | None
    signal: int | None
    stopped: Stopped | None
    stdout: bytes
    stderr: bytes
    cpu_seconds: float


def start_child(command: list[str], environment: dict[str, str], folder: Path | None = None) -> subprocess.Popen[bytes]:
    """Start ``command`` in ``folder``; it leads a process group of its own."""
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True
    )


def run_child(
    command: list[str] | subprocess.Popen[bytes],
    request: bytes,
    folder: Path,
    environment: dict[str, str],
    wall_s: float,
    folder_bytes: int = 1 << 32,
    entries: int = MAX_ENTRIES,
) -> ChildOutcome:
    """Run ``command`` in ``folder`` with ``request`` on standard input, for at most ``wall_s`` seconds by a fair clock.
    Or a process that ``start_child`` has started, and that waits for its request.

    It is stopped too when it has many threads, or more than ``folder_bytes`` or ``entries`` in ``folder``. The child
    leads a process group of its own; at the end the whole group is killed, whatever became of the child.
    ``request`` must fit into a pipe (64 KiB).
    """
    process = start_child(command, environment, folder) if isinstance(command, list) else command
    clock = FairClock(process.pid, wall_s)
    _inherit_priority(process.pid)
    stopped: Stopped | None = "late"
    watch = partial(trespass_of, process.pid, folder, folder_bytes, entries)
    said = (bytearray(), bytearray())
    try:
        with contextlib.suppress(BrokenPipeError):
            _pipe(process.stdin).write(request)
            _pipe(process.stdin).close()
        stopped = _listen(process, said, watch, clock) or _stays(process.pid, watch, clock)
    finally:
        code, cpu_seconds = _end(process)
    return ChildOutcome(
        exit_status=code if code >= 0 else None,
        signal=-code if code < 0 else None,
        stopped=stopped,
        stdout=bytes(said[0]),
        stderr=bytes(said[1]),
        cpu_seconds=cpu_seconds,
    )


def _inherit_priority(pid: int) -> None:
    """Where Linux schedules sessions as groups, the child's new one gives way as much as this process does."""
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(os.getpriority(os.PRIO_PROCESS, 0)))


def _end(process: subprocess.Popen[bytes]) -> tuple[int, float]:
    """Kill the process group, collect the child and close its pipes. Returns its exit code and processor time (s)."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    for stream in (process.stdin, process.stdout, process.stderr):
        with contextlib.suppress(BrokenPipeError):
            _pipe(stream).close()
    return process.returncode, usage.ru_utime + usage.ru_stime


def _listen(
    process: subprocess.Popen[bytes], said: tuple[bytearray, bytearray], watch: Watch, clock: FairClock
) -> Stopped | None:
    """Collect in ``said`` what the child says until it closes both streams; otherwise tell why it should be stopped."""
    with selectors.DefaultSelector() as selector:
        for stream, words in zip((_pipe(process.stdout), _pipe(process.stderr)), said, strict=True):
            selector.register(stream.fileno(), selectors.EVENT_READ, words)
        while selector.get_map():
            ready = selector.select(min(clock.left_s(), _LOOK_S))
            if not clock.left_s():
                return "late"
            if trespass := watch():
                return trespass
            for key, _ in ready:
                chunk = os.read(key.fd, _MAX_OUTPUT)
                key.data.extend(chunk)
                if len(key.data) > _MAX_OUTPUT:
                    return "talkative"
                if not chunk:
                    selector.unregister(key.fd)
    return None


def _stays(pid: int, watch: Watch, clock: FairClock) -> Stopped | None:
    """Why the child, which has closed its streams, should be stopped; None when it ends by itself in time.

    Its status stays to be collected.
    """
    while os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is None:
        if not clock.left_s():
            return "late"
        if trespass := watch():
            return trespass
        time.sleep(0.005)
    return None


def _pipe(stream: IO[bytes] | None) -> IO[bytes]:
    if stream is None:
        raise RuntimeError("the child was started without pipes")
    return stream

"""What one job's process may use: memory and disk space, limited within the process and watched from outside.

Within, the kernel refuses private memory beyond the limit (RLIMIT_DATA), so that an allocation fails there and the job
ends with a reason of its own. Address space (RLIMIT_AS) would be the wrong measure: CUDA reserves far more of it than
it uses. From outside, the worker looks at the pages that are the process' own: that also counts shared memory, which
RLIMIT_DATA does not. Pages that a fork shares with its worker count for neither.
"""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from regnf_core.importing.gate.report import ImportLimits
from regnf_state.settings import MIB, Settings

_SHARE = 0.75
"""Of the memory that is granted; the rest is for the worker, the system, and an import's process."""
_LEAST = 1024 * MIB
RESERVE = 128 * MIB
"""Beyond the limit, for writing down that it was reached."""
_NEAR = 0.8
"""Share of the limit."""
_KIB = 1024
_GROUPS = Path("/sys/fs/cgroup")
_LIMIT_OF_VERSION_1 = _GROUPS / "memory" / "memory.limit_in_bytes"
_PRIVATE = ("Private_Dirty:", "Swap:")


@dataclass(frozen=True)
class JobLimits:
    """Bytes that one job may use. memory: private to its process, fields that it opens included · scratch: temporary
    files."""

    memory: int
    scratch: int

    @classmethod
    def of(cls, settings: Settings) -> JobLimits:
        """The limits that the settings name. Without one for memory: three quarters of what the machine or its control
        group grants, divided by the workers, 1 GiB at least."""
        share = int(_SHARE * granted_memory() / max(1, settings.workers))
        return cls(settings.job_memory_bytes or max(_LEAST, share), settings.job_scratch_bytes)

    def hold_here(self) -> None:
        """Limit this process for the rest of its life. Call it in the job's own process."""
        memory = data_bytes() + self.memory
        if sys.platform.startswith("linux"):
            _limit(resource.RLIMIT_DATA, memory, memory + RESERVE)
        # A copy of a field from an object store may be as large as an import's file.
        largest = max(self.scratch, ImportLimits().file_bytes)
        _limit(resource.RLIMIT_FSIZE, largest, largest)

    def exceeded_by(self, pid: int, scratch: Path) -> str | None:
        """The reason to end the job's process, if it is over a limit."""
        if private_bytes(pid) > self.memory + RESERVE:
            return "JOB_MEMORY_LIMIT"
        return "JOB_DISK_LIMIT" if folder_bytes(scratch) > self.scratch else None

    def is_near(self, peak_memory: int) -> bool:
        """Whether a process that crashed with this peak most likely crashed for want of memory."""
        return peak_memory >= _NEAR * self.memory


def granted_memory(own_group: Path = Path("/proc/self/cgroup"), groups: Path = _GROUPS) -> int:
    """Bytes of memory that this machine has, or that a control group of this process may use, whichever is least."""
    found = [_machine_memory()]
    for path in (*_group_limits(own_group, groups), _LIMIT_OF_VERSION_1):
        with suppress(OSError, ValueError):
            found.append(int(path.read_text()))  # "max" without a limit
    return min(found)


def _group_limits(own_group: Path, groups: Path) -> Iterator[Path]:
    """The limits of this process' control group (version 2) and of all that it is part of."""
    with suppress(OSError):
        for line in own_group.read_text().splitlines():
            if line.startswith("0::/"):
                own = groups / line.removeprefix("0::/")
                yield from (folder / "memory.max" for folder in (own, *own.parents) if folder.is_relative_to(groups))


def held_memory_limit() -> int | None:
    """The limit of private memory that holds for this process; None: there is none."""
    soft, _ = resource.getrlimit(resource.RLIMIT_DATA)
    return None if soft == resource.RLIM_INFINITY else soft


def open_reserve() -> None:
    """Let this process use the reserve too: it has failed for want of memory, and has to write that down."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def data_bytes(pid: int | str = "self") -> int:
    """Private writable memory of a process, touched or not, as RLIMIT_DATA counts it. 0 where the system does not
    say."""
    return _KIB * _kib_of(Path(f"/proc/{pid}/status"), ("VmData:",))


def private_bytes(pid: int) -> int:
    """Memory that a process has written to and shares with no other. 0 where the system does not say."""
    return _KIB * _kib_of(Path(f"/proc/{pid}/smaps_rollup"), _PRIVATE)


def folder_bytes(folder: Path) -> int:
    """What the files in a folder take on disk; files and folders that go meanwhile do not count."""
    total = 0
    for place, folders, files in os.walk(folder):  # passes over a folder that is gone, where rglob raises
        for name in (*folders, *files):
            with suppress(OSError):
                total += 512 * os.lstat(os.path.join(place, name)).st_blocks
    return total


def _kib_of(path: Path, names: tuple[str, ...]) -> int:
    total = 0
    with suppress(OSError):
        for line in path.read_text().splitlines():
            name, *value = line.split()
            total += int(value[0]) if name in names else 0
    return total


def _machine_memory() -> int:
    return _KIB * _kib_of(Path("/proc/meminfo"), ("MemTotal:",)) or 1 << 62


def _limit(kind: int, soft: int, hard: int) -> None:
    """Set a limit, never above the one that holds already."""
    _, highest = resource.getrlimit(kind)
    if highest != resource.RLIM_INFINITY:
        soft, hard = min(soft, highest), min(hard, highest)
    resource.setrlimit(kind, (soft, hard))

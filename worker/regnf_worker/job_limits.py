"""What one job's process may use: memory and disk space, limited within the process and watched from outside.

Within, the kernel refuses private memory beyond the limit (RLIMIT_DATA), so that an allocation fails there and the job
ends with a reason of its own. Address space (RLIMIT_AS) would be the wrong measure: CUDA reserves far more of it than
it uses. From outside, the worker looks at the pages that are the process' own: that also counts shared memory, which
RLIMIT_DATA does not. Pages that a fork shares with its worker count for neither.
"""

from __future__ import annotations

import errno
import logging
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from regnf_core.errors import RegnfError
from regnf_core.importing.gate.report import ImportLimits
from regnf_state.blobs.base import StorageFullError
from regnf_state.reasons import problem_document
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
            return "OUT_OF_MEMORY"
        return "JOB_DISK_LIMIT" if folder_bytes(scratch) > self.scratch else None

    def is_near(self, peak_memory: int) -> bool:
        """Whether a process that crashed with this peak most likely crashed for want of memory."""
        return peak_memory >= _NEAR * self.memory


def granted_memory(own_group: Path = Path("/proc/self/cgroup"), groups: Path = _GROUPS) -> int:
    """Bytes of memory that this machine has, or that a control group of this process may use, whichever is least."""
    found = [_KIB * _kib_of(Path("/proc/meminfo"), ("MemTotal:",)) or 1 << 62]
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


def _limit(kind: int, soft: int, hard: int) -> None:
    """Set a limit, never above the one that holds already."""
    _, highest = resource.getrlimit(kind)
    if highest != resource.RLIM_INFINITY:
        soft, hard = min(soft, highest), min(hard, highest)
    resource.setrlimit(kind, (soft, hard))


# What went wrong, as the problem object that a record carries. No traceback and no path ever leaves through here.

OVER_LIMIT = {"OUT_OF_MEMORY": ("memory", "memory"), "JOB_DISK_LIMIT": ("temporary files", "scratch")}
"""Reasons of jobs that were over a limit, of what, and which of ``JobLimits``."""
_SETTING_OF = {
    "IMPORT_TIMEOUT": "REGNF_IMPORT_TIMEOUT_S",
    "IMPORT_TOO_COSTLY": "REGNF_IMPORT_WORK_S",
    "IMPORT_OUT_OF_MEMORY": "REGNF_IMPORT_MEMORY_BYTES",
    "JOB_TIMEOUT": "REGNF_JOB_TIMEOUT_S",
}
"""The settings of the limits, by the reasons that go with them."""
_GIB = 1 << 30
logger = logging.getLogger(__name__)
_OUT_OF_MEMORY_PHRASES = ("can't allocate memory", "out of memory", "cannot allocate memory", "bad_alloc")
_FULL = {errno.ENOSPC, errno.EDQUOT}
_AWAY = {errno.ENOENT, errno.EIO, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EROFS, errno.ESTALE}


def refusal(error: RegnfError) -> dict[str, Any]:
    """The problem of one of regnf's own refusals. Where a setting of the service set the limit, it is named."""
    setting = _SETTING_OF.get(error.reason)
    detail = str(error) if setting is None else f"{error} ({setting})"
    return problem_document(error.reason, detail, hint=error.hint)


def timeout(reason: str, limit_s: float) -> dict[str, Any]:
    """The problem of work that the worker stopped: JOB_TIMEOUT or IMPORT_TIMEOUT."""
    what = "job" if reason == "JOB_TIMEOUT" else "import"
    detail = f"the {what} took longer than the allowed {limit_s:g} s ({_SETTING_OF[reason]})"
    return problem_document(reason, detail)


def fault(error: Exception, what: str, limits: JobLimits | None = None) -> dict[str, Any]:
    """The problem of an exception that is not one of regnf's own refusals, and that is being handled.

    It is logged, as that of ``what``, with a word by which a person finds it. limits: those that hold for this process.
    """
    incident = uuid4().hex[:12]
    logger.exception("%s failed, incident %s", what, incident)
    if is_out_of_memory(error):
        of_gpu = "cuda" in str(error).lower()
        return problem_document("OUT_OF_MEMORY") if limits is None or of_gpu else over_limit("OUT_OF_MEMORY", limits)
    if limits is not None and isinstance(error, OSError) and error.errno == errno.EFBIG:
        return over_limit("JOB_DISK_LIMIT", limits)
    if isinstance(error, StorageFullError) or (isinstance(error, OSError) and error.errno in _FULL):
        return problem_document("STORAGE_FULL")
    return problem_document(
        "INTERNAL", f"Internal error. The log has the details under the incident {incident}.", incident=incident
    )


def over_limit(reason: str, limits: JobLimits) -> dict[str, Any]:
    """The problem of a job that was over one of its limits: OUT_OF_MEMORY or JOB_DISK_LIMIT."""
    what, name = OVER_LIMIT[reason]
    limit = getattr(limits, name)
    detail = f"The job needed more than the {limit / _GIB:.1f} GiB of {what} that one job may use here."
    return problem_document(reason, detail, limit_bytes=limit)


def are_files_away(error: Exception) -> bool:
    """Whether stored files fail or are missing: usually the volume is away, and another attempt may succeed."""
    return isinstance(error, OSError) and error.errno in _AWAY


def start_refused(error: OSError) -> str | None:
    """The reason of a job for which no process could be started, where there is one of its own."""
    if error.errno in _FULL:
        return "STORAGE_FULL"
    return "STORAGE_UNAVAILABLE" if are_files_away(error) else None


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out. torch says so in a RuntimeError on a CPU, in a subclass of it on a GPU."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(phrase in str(error).lower() for phrase in _OUT_OF_MEMORY_PHRASES)
    )

"""The first lines of the throw-away process: before it sees the upload it gives up all it does not need."""

from __future__ import annotations

import ctypes
import math
import os
import resource
import signal
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from regnf_core.importing.gate.fair_clock import LONGEST
from regnf_core.importing.gate.landlock import restrict_files
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.gate.system_calls import refuse_system_calls
from regnf_core.parent_process import die_with_parent

_PR_GET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_NO_NEW_PRIVS = 2, 4, 38
_CLONE_NEWUSER, _CLONE_NEWNET, _CLONE_NEWIPC = 0x10000000, 0x40000000, 0x08000000
_CAPABILITY_VERSION = 0x20080522
_OPEN_FILES = 64
_SYSTEM = """
/usr/lib /usr/lib64 /usr/local/lib /usr/local/cuda /usr/share /lib /lib64 /nix/store
/etc/ld.so.cache /etc/localtime /etc/ssl/openssl.cnf /dev/null /dev/urandom
/proc/cpuinfo /proc/meminfo /proc/stat /sys/devices/system/cpu /sys/devices/system/node
"""
"""Where libraries are, and which facts about the machine they read as they load. No service keeps a secret there."""


def confine(
    limits: ImportLimits, parent_pid: int, opened: Sequence[int], folder: Path, threads: bool = False
) -> dict[str, bool]:
    """Confine this process for the rest of its life; returns which confinements the kernel granted.

    ``opened`` are the files it was given, ``folder`` is where it may write. Resource limits always hold. A network
    namespace without interfaces and the system call filter each keep the process off the network; containers often
    forbid the first and allow the second. threads: allow new ones; whoever started this process counts them.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    die_with_parent(parent_pid)
    _be_first_to_go()
    _limit_resources(limits, threads)
    libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    no_network = _leave_network(libc)
    no_capabilities = _drop_capabilities(libc)
    no_new_privileges = libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
    return {
        "dies_with_parent": _dies_with_parent(libc),
        "network_namespace": no_network,
        "no_capabilities": no_capabilities,
        "no_new_privileges": no_new_privileges,
        "files_restricted": no_new_privileges and restrict_files([*opened, *_readable()], folder),
        "system_call_filter": no_new_privileges and refuse_system_calls(threads),
    }


def _be_first_to_go() -> None:
    """Where the machine runs out of memory, the kernel ends this process before the worker or the service."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


def _dies_with_parent(libc: ctypes.CDLL) -> bool:
    """Asked last: some changes of privileges take the signal back. The filter then keeps it from being changed."""
    signal_number = ctypes.c_int()
    told = libc.prctl(_PR_GET_PDEATHSIG, ctypes.byref(signal_number), 0, 0, 0)
    return bool(told == 0 and signal_number.value == signal.SIGKILL)


def _readable() -> list[int | Path]:
    """What this process reads besides the upload: its own code, libraries, itself.

    The folder that the package lies in is left out: where the code runs from a checkout it may hold anything.
    """
    package = Path(__file__).resolve().parents[2]
    prefixes = (Path(prefix) / name for prefix in (sys.base_prefix, sys.prefix) for name in ("lib", "lib64"))
    on_path = (Path(entry) for entry in sys.path if entry and Path(entry).resolve() != package.parent)
    itself = os.open("/proc/self", os.O_PATH | os.O_DIRECTORY)  # kept open: a rule holds for this one node only
    return [itself, package, *prefixes, *on_path, *map(Path, _SYSTEM.split())]


def _leave_network(libc: ctypes.CDLL) -> bool:
    """Move to a network namespace of our own, which has no interface that is up."""
    kinds = _CLONE_NEWNET | _CLONE_NEWIPC
    if libc.unshare(kinds) == 0:
        return True
    return bool(libc.unshare(kinds | _CLONE_NEWUSER) == 0)


def _drop_capabilities(libc: ctypes.CDLL) -> bool:
    """Give up what root, or a user namespace of its own, would let this process do."""
    return bool(libc.capset(struct.pack("=Ii", _CAPABILITY_VERSION, 0), bytes(24)) == 0)


def _limit_resources(limits: ImportLimits, threads: bool) -> None:
    wanted = [
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_NOFILE, _OPEN_FILES),
        (resource.RLIMIT_MEMLOCK, 0),
        (resource.RLIMIT_MSGQUEUE, 0),
        (resource.RLIMIT_SIGPENDING, 0),
    ]
    if limits.wall_s is not None:  # several threads need less time than they use of the processors
        wanted.append((resource.RLIMIT_CPU, math.ceil(LONGEST * limits.wall_s)))
    if not threads:  # the kernel counts those of all processes of the user, so it is none or no limit
        wanted.append((resource.RLIMIT_NPROC, 0))
    for kind, value in wanted:
        _, hard = resource.getrlimit(kind)
        highest = value + 1 if kind == resource.RLIMIT_CPU else value  # at the hard limit SIGKILL would hide the cause
        if hard != resource.RLIM_INFINITY:
            value, highest = min(value, hard), min(highest, hard)
        resource.setrlimit(kind, (value, highest))

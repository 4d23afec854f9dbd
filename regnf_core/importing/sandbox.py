"""The first lines of the throw-away process: before it sees the upload it gives up all it does not need."""

from __future__ import annotations

import ctypes
import os
import resource
import signal

from regnf_core.importing.report import ImportLimits
from regnf_core.importing.system_calls import refuse_system_calls

_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_NO_NEW_PRIVS = 1, 4, 38
_CLONE_NEWUSER, _CLONE_NEWNET, _CLONE_NEWIPC = 0x10000000, 0x40000000, 0x08000000
_OPEN_FILES = 256


def confine(limits: ImportLimits, parent_pid: int) -> dict[str, bool]:
    """Confine this process for the rest of its life; returns which confinements the kernel granted.

    Resource limits always hold. A network namespace without interfaces and the system call filter each keep the
    process off the network; containers often forbid the first and allow the second.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    die_with_parent = libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) == 0
    if os.getppid() != parent_pid:  # the parent died before the line above
        os._exit(1)
    _limit_resources(limits)
    libc.prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
    no_network = _leave_network(libc)
    no_new_privileges = libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
    return {
        "dies_with_parent": die_with_parent,
        "network_namespace": no_network,
        "no_new_privileges": no_new_privileges,
        "system_call_filter": no_new_privileges and refuse_system_calls(),
    }


def _leave_network(libc: ctypes.CDLL) -> bool:
    """Move to a network namespace of our own, which has no interface that is up."""
    kinds = _CLONE_NEWNET | _CLONE_NEWIPC
    if libc.unshare(kinds) == 0:
        return True
    return bool(libc.unshare(kinds | _CLONE_NEWUSER) == 0)


def _limit_resources(limits: ImportLimits) -> None:
    wanted = (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, limits.cpu_s),
        (resource.RLIMIT_AS, limits.memory_bytes),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_NOFILE, _OPEN_FILES),
    )
    for kind, value in wanted:
        _, hard = resource.getrlimit(kind)
        highest = value + 1 if kind == resource.RLIMIT_CPU else value  # at the hard limit SIGKILL would hide the cause
        if hard != resource.RLIM_INFINITY:
            value, highest = min(value, hard), min(highest, hard)
        resource.setrlimit(kind, (value, highest))

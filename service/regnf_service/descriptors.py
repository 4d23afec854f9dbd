"""File descriptors of this process: raised to what the system allows, shared out, and counted."""

from __future__ import annotations

import resource
from dataclasses import dataclass
from pathlib import Path

_ENOUGH = 65536
_LARGEST_BACKLOG = 2048
_LARGEST_RESERVE = 512


@dataclass(frozen=True)
class Share:
    """backlog: connections that one look at the socket may take in · connections: how many may stay.

    The rest is kept for stores, files, and whoever is just being refused: so `accept` never fails for want of one.
    """

    backlog: int
    connections: int


def raise_limit() -> int:
    """Allow as many as the system does, up to a number that is enough; returns how many may be open now."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    wanted = _ENOUGH if hard == unlimited else min(hard, _ENOUGH)
    if soft != unlimited and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return _ENOUGH if soft == unlimited else soft


def shared_out(limit: int, most_connections: int) -> Share:
    """What connections may have of ``limit`` descriptors: at least a quarter of them are for nothing else."""
    backlog = min(_LARGEST_BACKLOG, limit // 4)
    reserve = min(_LARGEST_RESERVE, 3 * limit // 8)
    return Share(backlog, max(1, min(most_connections, limit - backlog - reserve)))


def open_descriptors() -> int:
    """How many are open; 0 where the system does not tell."""
    try:
        return sum(1 for _ in Path("/proc/self/fd").iterdir())
    except OSError:
        return 0

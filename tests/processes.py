"""Which processes there are. One that ends while it is looked at is one that has ended, and no error.

But for ``children_of``: whoever asks for the children of one process takes it to be alive.
"""

from __future__ import annotations

import psutil


def children_of(pid: int) -> list[int]:
    """Processes whose parent this is, the newest one last; zombies count. Raises psutil.NoSuchProcess when the parent
    has ended."""
    return [child.pid for child in sorted(psutil.Process(pid).children(), key=lambda child: child.create_time())]


def descendants_of(pid: int) -> list[int]:
    """Every process below this one; zombies count."""
    try:
        return [child.pid for child in psutil.Process(pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def alive(pid: int) -> bool:
    """Whether the process exists and is no zombie."""
    try:
        return psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.NoSuchProcess:
        return False


def command_of(pid: int) -> list[str]:
    """Its program and arguments; none if it has ended."""
    try:
        return psutil.Process(pid).cmdline()
    except psutil.NoSuchProcess:
        return []


def processor_seconds(pid: int) -> float:
    """Of the process, and of its children that have ended and were waited for."""
    try:
        return float(sum(psutil.Process(pid).cpu_times()[:4]))
    except psutil.NoSuchProcess:
        return 0.0

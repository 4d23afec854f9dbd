"""Which processes there are. One that ends while it is looked at is one that has ended, and no error."""

from __future__ import annotations

import psutil


def children_of(pid: int) -> list[int]:
    """Processes whose parent this is; zombies count."""
    return _below(pid, recursive=False)


def descendants_of(pid: int) -> list[int]:
    """Every process below this one; zombies count."""
    return _below(pid, recursive=True)


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


def _below(pid: int, recursive: bool) -> list[int]:
    try:
        return [child.pid for child in psutil.Process(pid).children(recursive)]
    except psutil.NoSuchProcess:
        return []

"""The job process that is still at the pictures of a result which is out. The worker goes on meanwhile."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from regnf_worker import kernel

_DEATH_S = 10.0
"""A killed process is gone within this time."""


@dataclass(frozen=True)
class ChildAtPictures:
    """Such a process. ended: the reading end of its pipe · until: when it has had its time, by the monotonic clock ·
    on_end: called once it is gone."""

    pid: int
    ended: int
    until: float
    on_end: Callable[[], None]


class Finishing:
    """One such process at most."""

    def __init__(self) -> None:
        self._child: ChildAtPictures | None = None

    def take(self, child: ChildAtPictures) -> None:
        """Look after a process, once there is no other."""
        self._child = child

    def is_free(self, seconds: float = 0.0) -> bool:
        """Whether there is none any more, waited for so many seconds at most. One that has had its time is killed."""
        child = self._child
        if child is None:
            return True
        if time.monotonic() >= child.until:
            self._kill(child)
        if not isinstance(kernel.wait_for_exit(child.pid, child.ended, seconds), kernel.Exit):
            return False
        self._child = None
        os.close(child.ended)
        child.on_end()
        return True

    def end(self, grace_s: float) -> None:
        """The worker stops: what is not made within its grace is missing."""
        if not self.is_free(grace_s) and self._child is not None:
            self._kill(self._child)
            self.is_free(_DEATH_S)

    @staticmethod
    def _kill(child: ChildAtPictures) -> None:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)

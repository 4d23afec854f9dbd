"""Log entries that repeat: a fault that happens thousands of times a second must not fill a disk."""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable

_BURST = 20
_PERIOD_S = 10.0
_MOST_KINDS = 512


class RepeatLimit(logging.Filter):
    """Lets warnings and errors of one kind pass twenty times in ten seconds; the next one tells how many did not.

    A kind is a logger, a level and a message without what is filled in.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._kinds: OrderedDict[tuple[str, int, str], list[float]] = OrderedDict()
        """By kind: when its period began, how many passed in it, how many did not."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        kind = (record.name, record.levelno, str(record.msg)[:200])
        now = self._clock()
        began, passed, left_out = self._kinds.pop(kind, (now, 0, 0))
        if now - began >= _PERIOD_S:
            if left_out:
                record.msg = f"{record.msg} ({left_out:.0f} more like this were left out)"
            began, passed, left_out = now, 0, 0
        passes = passed < _BURST
        self._kinds[kind] = [began, passed + passes, left_out + (not passes)]
        if len(self._kinds) > _MOST_KINDS:
            self._kinds.popitem(last=False)
        return passes

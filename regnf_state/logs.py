"""Logs on stderr, one line an entry: plain for people, or JSON for collectors."""

from __future__ import annotations

import json
import logging
import re
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

from regnf_core.library_entries import UNSHOWN

# Log entries that repeat: a fault that happens thousands of times a second must not fill a disk.

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


ACCESS_LOGGER = "regnf_service.access"
_context: ContextVar[dict[str, Any]] = ContextVar("log_context")
_PLAIN = "%(asctime)s %(levelname)-7s %(name)s %(message)s"
_BREAKS = re.compile(f"[{UNSHOWN}]")
_STANDARD = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "color_message"}


@contextmanager
def log_context(**members: Any) -> Iterator[None]:
    """Entries written in this block, also by threads started in it, have these members: request_id, job_id, caller."""
    token = _context.set(_context.get({}) | members)
    try:
        yield
    finally:
        _context.reset(token)


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, message, its context, what was given as ``extra``, a traceback."""

    def format(self, record: logging.LogRecord) -> str:
        entry = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "process": record.process,
            "message": record.getMessage(),
        }
        entry |= _context.get({})
        entry |= {name: value for name, value in record.__dict__.items() if name not in _STANDARD}
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


class PlainFormatter(logging.Formatter):
    """One line an entry, but for its traceback: whatever breaks or turns a line is escaped."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 -- the base class's name
        return _BREAKS.sub(lambda found: f"\\u{ord(found[0]):04x}", super().formatMessage(record))


def configure_logging(log_format: Literal["text", "json"], level: int = logging.INFO) -> None:
    """Send every logger's entries to stderr in one format, once; what libraries had set up is taken down."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format == "json" else PlainFormatter(_PLAIN))
    root = logging.getLogger()
    handler.addFilter(RepeatLimit())
    root.handlers = [handler]
    root.setLevel(level)
    # a line for every request is for collectors; people look at what goes wrong
    logging.getLogger(ACCESS_LOGGER).setLevel(logging.NOTSET if log_format == "json" else logging.WARNING)
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "rq.worker", "rq.job"):
        logger = logging.getLogger(name)
        logger.handlers = []
        logger.propagate = True

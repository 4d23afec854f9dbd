"""Logs on stderr, one line an entry: plain for people, or JSON for collectors."""

from __future__ import annotations

import json
import logging
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal

from regnf_core.labels import UNSHOWN
from regnf_state.log_limits import RepeatLimit

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

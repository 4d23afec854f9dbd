"""The server's HTTP parser with bounds on what a few bytes may cost it: heads, tiny chunks."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import h11

_MOST_HEAD_BYTES = 16 * 1024
_MOST_HEAD_LINES = 128
_FREE_CHUNKS = 256
_LEAST_CHUNK_BYTES = 256
"""A body of more chunks than those must have chunks of this size on average."""
_BLANK_LINE = re.compile(rb"\n\r?\n")
_HEAD_TOO_LARGE = 431


class BoundedParser(h11.Connection):
    """``clock`` tells when a request began.

    request_at: when the latest head was complete · body_bytes: what has come of its body · is_paused: whether a request
    waits until the one before it is answered · fault: the status for what is no HTTP.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        super().__init__(h11.SERVER, _MOST_HEAD_BYTES)
        self._clock = clock
        self._chunks = 0
        self.request_at = 0.0
        self.body_bytes = 0
        self.is_paused = False
        self.fault = 400

    def next_event(self) -> Any:
        """As the base class. Raises RemoteProtocolError also for what costs too much."""
        try:
            if self.their_state is h11.IDLE:
                self._check_head()
            event = super().next_event()
            self.is_paused = event is h11.PAUSED
            if isinstance(event, h11.Request):
                _check_framing(event)
                self.request_at, self.body_bytes, self._chunks = self._clock(), 0, 0
            elif isinstance(event, h11.Data):
                self._count(event)
        except h11.RemoteProtocolError as error:
            self.fault = error.error_status_hint
            raise
        return event

    def _check_head(self) -> None:
        data = self.trailing_data[0]
        end = _BLANK_LINE.search(data)
        size = len(data) if end is None else end.end()
        if size > _MOST_HEAD_BYTES or data.count(b"\n", 0, size) > _MOST_HEAD_LINES:
            raise h11.RemoteProtocolError("the head is too large", error_status_hint=_HEAD_TOO_LARGE)

    def _count(self, event: h11.Data) -> None:
        self.body_bytes += len(event.data)
        self._chunks += event.chunk_start
        if self._chunks > _FREE_CHUNKS and self.body_bytes < _LEAST_CHUNK_BYTES * (self._chunks - _FREE_CHUNKS):
            raise h11.RemoteProtocolError("the chunks are too small")


def _check_framing(request: h11.Request) -> None:
    """A body has one length. A proxy that goes by another one of two would take what follows for a request."""
    names = {name for name, _ in request.headers}
    if b"transfer-encoding" in names and (b"content-length" in names or request.http_version < b"1.1"):
        raise h11.RemoteProtocolError("the end of the body is not clear")

"""The server's protocol with limits in time and number, which it has not itself: for slow clients, and for many."""

from __future__ import annotations

import asyncio
import json
import math
import re
import select
import socket
from collections.abc import Callable
from functools import cache, partial
from http import HTTPStatus
from typing import Any

import h11
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from regnf_service.http.connections import ClientClock, Connections, site_of
from regnf_service.http.middleware import fair_key
from regnf_service.http.problems import MEDIA_TYPE, SECURITY_HEADERS
from regnf_service.problem import RETRY_LATER, Problem
from regnf_state.ownership import ANONYMOUS

# The server's HTTP parser with bounds on what a few bytes may cost it: heads, tiny chunks.

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


# Problems as bytes, for connections that never become a request of the application.

_RETRY_STATUSES = (408, 503)


@cache
def raw_answer(reason: str) -> bytes:
    """A whole answer after which the connection ends."""
    problem = Problem(reason)
    body = json.dumps(problem.document()).encode()
    headers = {"Content-Type": MEDIA_TYPE, "Content-Length": str(len(body)), "Connection": "close", **SECURITY_HEADERS}
    if problem.status in _RETRY_STATUSES:
        headers |= RETRY_LATER
    lines = [f"HTTP/1.1 {problem.status} {HTTPStatus(problem.status).phrase}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    return "\r\n".join([*lines, "", ""]).encode() + body


_SLICE_BYTES = 16 * 1024
_BLOCK_BYTES = 64 * 1024
"""Of an answer, that is handed to the connection at once."""
_LINGER_S = 10.0
"""How long what was answered last may take to be read, and what a client still sends to come to its end."""
_VANISHED_MS = 60_000
_FAULTS = {431: "HEADERS_TOO_LARGE"}


class GuardedProtocol(H11Protocol):
    """One connection. It watches no time itself: ``connections`` asks it by when its client must be done."""

    conn: BoundedParser

    def __init__(self, *arguments: Any, connections_held: Connections, clock: ClientClock, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.conn = BoundedParser(self.loop.time)
        self.site = ""
        self._held = connections_held
        self._clock = clock
        self._admitted = False
        self._inbox = bytearray()
        self.app_state = {**self.app_state, "connection": self}
        self.quiet_since = self._paused_at = 0.0
        """When its client was answered last, or connected."""
        self._paused_with = 0
        self._behind_s = 0.0
        """How much later its client reads than the slowest that may: what it has waited less what it has read."""
        self._pending = 0
        """Bytes of the answer that are not handed to the connection yet."""
        self._who = ""
        self._closing_since: float | None = None
        self.app: Any = partial(self._answer_in_blocks, self.app)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.site = site_of(str((transport.get_extra_info("peername") or ("",))[0]))
        self.quiet_since = self.loop.time()
        self.transport = transport
        self._admitted = self._held.admit(self)
        if not self._admitted:
            transport.write(raw_answer("TOO_MANY_CONNECTIONS"))
            transport.close()
            return
        _set_options(transport.get_extra_info("socket"))
        # A round of the loop reads once from each connection: a hundred that send 256 KiB each, the default size, would
        # make everybody wait a quarter of a second.
        transport.max_size = _BLOCK_BYTES  # type: ignore[attr-defined]
        transport.set_write_buffer_limits(high=0)  # so that what is not read at once is counted, and ends the writing
        super().connection_made(transport)

    async def _answer_in_blocks(self, app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
        """The application. Whatever it answers waits here until the client reads, and is counted from the first byte
        that has to wait."""

        async def send_in_blocks(message: Message) -> None:
            body: bytes = message.get("body", b"")
            if not body:
                await send(message)
                return
            self._who = fair_key(scope, scope["state"].get("owner") or ANONYMOUS)
            for begin in range(0, len(body), _BLOCK_BYTES):
                if self.flow.write_paused:
                    self._pending = len(body) - begin
                    self._count_unread()
                    await self.flow.drain()
                block = body[begin : begin + _BLOCK_BYTES]
                self._pending = len(body) - begin - len(block)
                more = message.get("more_body", False) or self._pending > 0
                await send({"type": message["type"], "body": block, "more_body": more})

        await app(scope, receive, send_in_blocks)

    def _count_unread(self) -> None:
        """An answer that waits takes about a block more than its bytes (measured): buffers on the way, the call."""
        unread = self._pending + self.transport.get_write_buffer_size()
        self._held.note_unread(self, self._who, unread + _BLOCK_BYTES if unread else 0)

    def connection_lost(self, exc: Exception | None) -> None:
        self._held.remove(self)
        self._inbox.clear()
        self.app_state = {}
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """In slices, so that the parser never holds more than one of what it cannot use yet."""
        if self._admitted:
            self._inbox += data
            self._feed()

    def _feed(self) -> None:
        while self._inbox and not self.conn.is_paused and not self.transport.is_closing():
            piece = bytes(self._inbox[:_SLICE_BYTES])
            del self._inbox[:_SLICE_BYTES]
            super().data_received(piece)

    def on_response_complete(self) -> None:
        self.quiet_since = self.loop.time()
        super().on_response_complete()
        self._feed()

    def pause_writing(self) -> None:
        self._paused_at = self.loop.time()
        self._paused_with = self.transport.get_write_buffer_size()
        super().pause_writing()
        self._count_unread()

    def resume_writing(self) -> None:
        late_s = self.loop.time() - self._paused_at - self._paused_with / self._clock.bytes_per_s
        self._behind_s = max(0.0, self._behind_s + late_s)
        super().resume_writing()
        self._count_unread()

    def send_400_response(self, msg: str) -> None:  # noqa: ARG002 -- the base class's signature
        """What follows cannot be understood. An answer of the application that has begun is left as it is."""
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            self.transport.write(raw_answer(_FAULTS.get(self.conn.fault, "MALFORMED_REQUEST")))
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._close()

    def _unsupported_upgrade_warning(self) -> None:
        """No line in the log for each: the request is answered as if it had not asked."""

    def due(self) -> float:
        """The loop's time by which the client must be done; infinite while it is served."""
        if self.transport.is_closing():
            self._closing_since = self._closing_since or self.loop.time()
            return self._closing_since + _LINGER_S
        if self.flow.write_paused:
            read = max(0, self._paused_with - self.transport.get_write_buffer_size())
            return self._clock.due(self._paused_at, read) - self._behind_s
        if self.cycle is None or self.cycle.response_complete:
            return self.quiet_since + self._clock.head_s
        if self.cycle.more_body and not self.flow.read_paused:
            # the application answers 408 before: this is for what it does not read, and for making room
            return self._clock.due(self.conn.request_at, self.conn.body_bytes) + self._clock.stall_s
        return math.inf

    def must_make_room_by(self) -> float:
        """The same if another connection has no place: a client that asks ahead counts as one that waits."""
        return self.quiet_since + self._clock.head_s if self.conn.is_paused else self.due()

    def has_sent(self) -> bool:
        """Whether something of the client waits to be read: many connections come in before the first is read."""
        if self.flow.read_paused or self.transport.is_closing():
            return False
        look = select.poll()
        look.register(self.transport.get_extra_info("socket").fileno(), select.POLLIN)
        return bool(look.poll(0))

    def stuck_since(self) -> float:
        """Since when the client has read nothing, if something waits to be read."""
        return self._paused_at if self.flow.write_paused else self.loop.time()

    def end(self, *, politely: bool) -> None:
        """Close the connection; politely: with an answer to a head that has not come to its end."""
        idle = self.cycle is None or self.cycle.response_complete
        if not politely or not idle or self.transport.is_closing() or self.flow.write_paused:
            self.transport.abort()
            return
        if self.conn.trailing_data[0]:
            self.transport.write(raw_answer("REQUEST_STALLED"))
        self._close()

    def _close(self) -> None:
        self._closing_since = self.loop.time()
        self.transport.close()


def _set_options(connection: socket.socket | None) -> None:
    """A peer that is gone without a word is noticed within a minute or two, also while nothing is sent.

    The kernel takes no more ahead than it can soon send: else it would hold megabytes for a client that does not read,
    and one that reads slowly would seem not to read at all.
    """
    if connection is None or connection.family not in (socket.AF_INET, socket.AF_INET6):
        return
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    values = {"TCP_KEEPIDLE": 60, "TCP_KEEPINTVL": 15, "TCP_KEEPCNT": 4, "TCP_USER_TIMEOUT": _VANISHED_MS}
    for name, value in (values | {"TCP_NOTSENT_LOWAT": _BLOCK_BYTES}).items():
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

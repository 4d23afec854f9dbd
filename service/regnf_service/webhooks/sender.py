"""Sending one message: a POST to an address that was looked at, redirects not followed, the answer's body not read."""

from __future__ import annotations

import asyncio
import socket
import ssl
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

import httpcore

TIMEOUT_S = 10.0
"""For everything together: the name, the connection, the handshake, the message and the answer's head."""
_NEXT_ADDRESS_S = 3.0
"""Of a name with several addresses the next one is tried after this."""
_ANSWER_BYTES = 64 << 10
"""Of the answer, until its status is there. Interim answers (1xx) may come without end."""


class SendError(Exception):
    """No answer came. ``reason`` is a word for it; addresses and the like stay out of it."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class _BoundedStream(httpcore.AsyncNetworkStream):
    """A connection that gives so many bytes and no more."""

    def __init__(self, inner: httpcore.AsyncNetworkStream, left: int) -> None:
        self._inner = inner
        self._left = left

    async def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        if not self._left:
            raise SendError("ANSWER_TOO_LARGE")
        found = await self._inner.read(min(max_bytes, self._left), timeout)
        self._left -= len(found)
        return found

    async def write(self, buffer: bytes, timeout: float | None = None) -> None:
        await self._inner.write(buffer, timeout)

    async def aclose(self) -> None:
        await self._inner.aclose()

    async def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.AsyncNetworkStream:
        try:
            return _BoundedStream(await self._inner.start_tls(ssl_context, server_hostname, timeout), self._left)
        except BaseException:  # httpcore does not close a connection whose handshake is broken off
            await self._inner.aclose()
            raise

    def get_extra_info(self, info: str) -> Any:
        return self._inner.get_extra_info(info)


class _GuardedNetwork(httpcore.AsyncNetworkBackend):
    """Connects to the very addresses that it has checked, so that a name cannot resolve to others in between."""

    def __init__(self, permits: Callable[[str], bool]) -> None:
        self._permits = permits
        self._inner = httpcore.AnyIOBackend()
        self._lookups: dict[tuple[str, int], asyncio.Future[list[str]]] = {}

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,  # noqa: ARG002
        socket_options: Iterable[Any] | None = None,  # noqa: ARG002
    ) -> httpcore.AsyncNetworkStream:
        addresses = await self._addresses(host, port)
        if not addresses:
            raise SendError("UNRESOLVED")
        if not all(map(self._permits, addresses)):
            raise SendError("ADDRESS_NOT_ALLOWED")
        for address in addresses[:-1]:
            with suppress(httpcore.ConnectError, httpcore.ConnectTimeout):
                return await self._connected(address, port, _NEXT_ADDRESS_S)
        return await self._connected(addresses[-1], port, timeout)

    async def _connected(self, address: str, port: int, timeout: float | None) -> httpcore.AsyncNetworkStream:
        return _BoundedStream(await self._inner.connect_tcp(address, port, timeout), _ANSWER_BYTES)

    async def _addresses(self, host: str, port: int) -> list[str]:
        """Those of a name. However many ask for it, one thread at a time looks it up.

        A lookup cannot be broken off. Its thread is a daemon, so that the process need not wait for it at its end.
        """
        asked = self._lookups.get((host, port))
        if asked is None or asked.get_loop() is not asyncio.get_running_loop():
            asked = self._lookups[host, port] = asyncio.get_running_loop().create_future()
            asked.add_done_callback(lambda _: self._lookups.pop((host, port), None))
            threading.Thread(target=_look_up, args=(host, port, asked), name="webhook name", daemon=True).start()
        return await asyncio.shield(asked)

    async def connect_unix_socket(self, *_: Any, **__: Any) -> httpcore.AsyncNetworkStream:
        raise SendError("ADDRESS_NOT_ALLOWED")


def _look_up(host: str, port: int, asked: asyncio.Future[list[str]]) -> None:
    """Give ``asked`` the addresses; none where the name has none."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        found = []
    addresses = list(dict.fromkeys(str(entry[4][0]) for entry in found))

    def tell() -> None:
        if not asked.done():
            asked.set_result(addresses)

    with suppress(RuntimeError):  # the loop was closed in the meantime
        asked.get_loop().call_soon_threadsafe(tell)


class HttpSender:
    """Sends over TCP and TLS with certificates checked. ``permits`` says which addresses may be connected to."""

    def __init__(self, permits: Callable[[str], bool], timeout_s: float = TIMEOUT_S) -> None:
        self._network = _GuardedNetwork(permits)
        self._tls = httpcore.default_ssl_context()
        self._timeout_s = timeout_s

    async def send(self, url: str, headers: Mapping[str, str], body: bytes) -> int:
        """The status of the answer. Nothing that the receiver does or leaves undone makes it last longer than the time
        limit. Raises SendError."""
        given = [*headers.items(), ("Connection", "close")]
        try:
            async with (
                asyncio.timeout(self._timeout_s),
                httpcore.AsyncConnectionPool(self._tls, network_backend=self._network) as pool,
                pool.stream("POST", url, headers=given, content=body) as answer,
            ):
                return int(answer.status)
        except (TimeoutError, httpcore.TimeoutException) as error:
            raise SendError("TIMEOUT") from error
        except (httpcore.NetworkError, httpcore.ProtocolError, OSError) as error:
            raise SendError("CONNECTION_FAILED") from error

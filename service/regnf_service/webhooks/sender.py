"""Sending one message: a POST to an address that was looked at, redirects not followed, the answer not read."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import httpcore

TIMEOUT_S = 10.0
_TIMEOUTS = {"connect": 5.0, "read": TIMEOUT_S, "write": 5.0, "pool": 5.0}


class SendError(Exception):
    """No answer came. ``reason`` is a word for it; addresses and the like stay out of it."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Sender(Protocol):
    """Sends bytes to a URL."""

    def send(self, url: str, headers: Mapping[str, str], body: bytes) -> int:
        """The status of the answer. Raises SendError."""
        ...


class _GuardedNetwork(httpcore.NetworkBackend):
    """Connects to the very addresses that it has checked, so that a name cannot resolve to others in between."""

    def __init__(self, permits: Callable[[str], bool]) -> None:
        self._permits = permits
        self._inner = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise SendError("UNRESOLVED") from error
        addresses = list(dict.fromkeys(str(entry[4][0]) for entry in found))
        if not all(map(self._permits, addresses)):
            raise SendError("ADDRESS_NOT_ALLOWED")
        for last, address in enumerate(addresses, 1 - len(addresses)):
            try:
                return self._inner.connect_tcp(address, port, timeout, local_address, socket_options)
            except httpcore.ConnectError:
                if not last:
                    raise
        raise SendError("UNRESOLVED")

    def connect_unix_socket(self, *_: Any, **__: Any) -> httpcore.NetworkStream:
        raise SendError("ADDRESS_NOT_ALLOWED")


class HttpSender:
    """A Sender over TCP and TLS with certificates checked. ``permits`` says which addresses may be connected to."""

    def __init__(self, permits: Callable[[str], bool]) -> None:
        self._network = _GuardedNetwork(permits)

    def send(self, url: str, headers: Mapping[str, str], body: bytes) -> int:
        given = [*headers.items(), ("Connection", "close")]
        try:
            with (
                httpcore.ConnectionPool(network_backend=self._network, retries=0) as pool,
                pool.stream("POST", url, headers=given, content=body, extensions={"timeout": _TIMEOUTS}) as answer,
            ):
                return answer.status
        except httpcore.TimeoutException as error:
            raise SendError("TIMEOUT") from error
        except (httpcore.NetworkError, httpcore.ProtocolError, OSError) as error:
            raise SendError("CONNECTION_FAILED") from error

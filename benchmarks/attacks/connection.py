"""One request over one connection: what came back, or how the connection ended."""

from __future__ import annotations

import socket
from contextlib import suppress
from dataclasses import dataclass

_MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class Reply:
    """``status`` is 0 where the connection was closed without one, -1 where nothing came in time."""

    status: int
    headers: dict[str, str]
    body: bytes


def exchange(address: tuple[str, int], data: bytes, patience_s: float, timeout_s: float) -> Reply:
    """Send the bytes and read the answer to its end, a mebibyte of it at most.

    After ``patience_s`` without an answer the sending side is closed: the request may claim more bytes than it has.
    """
    received = bytearray()
    try:
        with socket.create_connection(address, timeout=timeout_s) as connection:
            with suppress(OSError):  # the service may refuse before it has read everything: its answer counts
                connection.sendall(data)
            connection.settimeout(patience_s)
            try:
                received += connection.recv(65536)
            except TimeoutError:
                connection.settimeout(timeout_s)
                connection.shutdown(socket.SHUT_WR)
            connection.settimeout(timeout_s)
            while len(received) < _MOST_BYTES and (chunk := connection.recv(65536)):
                received += chunk
    except TimeoutError:
        if not received:
            return Reply(-1, {}, b"")
    except OSError:
        pass  # reset: what has arrived counts
    return _parsed(bytes(received))


def _parsed(data: bytes) -> Reply:
    head, _, body = data.partition(b"\r\n\r\n")
    lines = head.decode("latin-1").split("\r\n")
    words = lines[0].split(" ")
    if len(words) < 2 or not words[1].isdigit():
        return Reply(0, {}, b"")
    pairs = (line.partition(":") for line in lines[1:])
    return Reply(int(words[1]), {name.strip().lower(): value.strip() for name, _, value in pairs}, body)

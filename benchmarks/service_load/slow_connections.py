"""Holds slow connections of four kinds to a service, in a process of its own; each that is cut off is made anew.

    python -m benchmarks.service_load.slow_connections PORT COUNT SECONDS TOKEN

A quarter each: heads that never end, a byte a second; bodies of uploads, a byte a second; answers that are never read;
connections that stay idle after an answer. Prints how many were made and how many were closed by the service.
"""

from __future__ import annotations

import asyncio
import json
import resource
import socket
import sys
import time
from collections import Counter

_DROP_EVERY_S = 1.0
_RETRY_S = 5.0
_FIRST_WITHIN_S = 20.0
_HOST = b"Host: 127.0.0.1\r\nAuthorization: Bearer " + (sys.argv[4] if len(sys.argv) > 4 else "").encode() + b"\r\n"
_BODY = b"POST /fields HTTP/1.1\r\n" + _HOST + b"Content-Length: 100000000\r\n\r\n" + b"\x10" + bytes(7)
_LARGE_ANSWER = b"GET /openapi.yaml HTTP/1.1\r\n" + _HOST + b"\r\n"


async def unfinished_head(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"GET /healthz HTTP/1.1\r\n" + _HOST + b"X-Slow: ")
    await _trickle(reader, writer, b"x")


async def trickled_body(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(_BODY)
    await _trickle(reader, writer, b"\0")


async def unread_answers(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:  # noqa: ARG001
    """The reader's buffer is full after a part of the first of them, and it stops."""
    writer.write(_LARGE_ANSWER * 3)
    while not writer.is_closing():
        await asyncio.sleep(_DROP_EVERY_S)
        writer.write(b"G")


async def idle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"GET /healthz HTTP/1.1\r\n" + _HOST + b"\r\n")
    while await reader.read(65536):
        pass


async def _trickle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, drop: bytes) -> None:
    while not reader.at_eof() and not writer.is_closing():
        writer.write(drop)
        await writer.drain()
        await asyncio.sleep(_DROP_EVERY_S)


_KINDS = (unfinished_head, trickled_body, unread_answers, idle)


async def hold(number: int, port: int, until: float, told: Counter[str]) -> None:
    """One connection after the other, until the end."""
    kind = _KINDS[number % len(_KINDS)]
    while (left := until - time.monotonic()) > 0:
        writer = None
        try:
            async with asyncio.timeout(left):
                connection = socket.socket()
                connection.setblocking(False)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                await asyncio.get_running_loop().sock_connect(connection, ("127.0.0.1", port))
                reader, writer = await asyncio.open_connection(sock=connection, limit=4096)
                told["made"] += 1
                await kind(reader, writer)
                told["closed by the service"] += 1
        except TimeoutError:
            told["held to the end"] += 1
        except OSError:
            told["closed by the service"] += 1
        finally:
            if writer is not None:
                writer.transport.abort()
        await asyncio.sleep(_RETRY_S)


async def attack(port: int, count: int, seconds: float) -> Counter[str]:
    told: Counter[str] = Counter()
    until = time.monotonic() + seconds
    async with asyncio.TaskGroup() as group:
        for number in range(count):
            group.create_task(hold(number, port, until, told))
            await asyncio.sleep(_FIRST_WITHIN_S / count)
    return told


def main() -> None:
    port, count, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    sys.stdout.write(json.dumps(asyncio.run(attack(port, count, seconds))) + "\n")


if __name__ == "__main__":
    main()

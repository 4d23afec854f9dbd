"""A network between the service and what it needs: slow, broken off or closed, as a test wishes."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
from collections.abc import Awaitable, Callable
from contextlib import suppress
from types import TracebackType

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]
_AT_ONCE = struct.pack("ii", 1, 0)
"""For SO_LINGER: closing sends a reset."""
_BLOCK_BYTES = 1 << 16


def to_unix(path: str) -> Callable[[], Awaitable[Streams]]:
    return lambda: asyncio.open_unix_connection(path)


def to_port(port: int) -> Callable[[], Awaitable[Streams]]:
    return lambda: asyncio.open_connection("127.0.0.1", port)


class Proxy:
    """Forwards connections on a port of loopback to a server; runs in a thread of its own while it is entered."""

    def __init__(self, connect: Callable[[], Awaitable[Streams]]) -> None:
        self._connect = connect
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._open: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self.delay_s = 0.0
        """What every block of an answer is held back for."""
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.port: int = listener.getsockname()[1]

    def __enter__(self) -> Proxy:
        self._thread.start()
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def open(self) -> None:
        """Take connections."""
        asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result()

    def close(self) -> None:
        """Break off what is open and refuse what comes."""
        asyncio.run_coroutine_threadsafe(self._refuse(), self._loop).result()

    def reset(self) -> int:
        """Break off every connection; how many that were."""
        return asyncio.run_coroutine_threadsafe(self._break_off(), self._loop).result()

    async def _listen(self) -> None:
        self._server = await asyncio.start_server(self._join, "127.0.0.1", self.port)

    async def _refuse(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None
        await self._break_off()
        await asyncio.gather(*self._tasks)

    async def _break_off(self) -> int:
        whole = [writer for writer in self._open if not writer.is_closing()]
        for writer in whole:
            if (one := writer.get_extra_info("socket")).family == socket.AF_INET:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
            writer.transport.abort()
        return len(whole)

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self._open.add(writer)
        try:
            server_reader, server_writer = await self._connect()
        except OSError:
            pass  # nobody is there to answer
        else:
            self._open.add(server_writer)
            pumps = self._pump(reader, server_writer, hold_back=False), self._pump(server_reader, writer)
            await asyncio.gather(*pumps)
            self._open.discard(server_writer)
        finally:
            self._open.discard(writer)
            self._tasks.discard(task)
            writer.transport.abort()

    async def _pump(self, source: asyncio.StreamReader, target: asyncio.StreamWriter, hold_back: bool = True) -> None:
        """Forward until either side ends."""
        with suppress(OSError):
            while block := await source.read(_BLOCK_BYTES):
                if hold_back and self.delay_s:
                    await asyncio.sleep(self.delay_s)
                target.write(block)
                await target.drain()
        target.close()

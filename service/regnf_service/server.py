"""The HTTP server of `regnf serve` and of the images: uvicorn, with limits on connections."""

from __future__ import annotations

import asyncio
import errno
import gc
import logging
import socket
import sys
from functools import partial
from typing import Any, cast

import uvicorn
from fastapi import FastAPI

from regnf_service.app import create_app
from regnf_service.descriptors import raise_limit, shared_out
from regnf_service.http.connections import ClientClock, Connections
from regnf_service.http.guarded_protocol import GuardedProtocol
from regnf_state.settings import MIB, Settings

_DRAIN_S = 5
"""How long open requests may go on once the process is told to stop."""
_MOST_UNREAD = 64 * MIB
_EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_SHED = 64
_SWITCH_S = 0.001
"""After how long a thread that computes lets the next one on: a call passes through several, and each time waits for
those of others. The interpreter's own 5 ms make that a tenth of a second beside four of them."""
_COLLECTIONS = (2_000, 50, 1_000)
"""After so many new objects these are looked through, every 50th time older ones too, every 50,000th time all."""
logger = logging.getLogger(__name__)


class GuardedServer(uvicorn.Server):
    """Serves one application on sockets that it is given."""

    def __init__(self, settings: Settings) -> None:
        share = shared_out(raise_limit(), settings.max_connections)
        of_address = min(settings.max_connections_per_address or max(1, share.connections // 2), share.connections)
        self._connections = Connections(share.connections, of_address, _MOST_UNREAD)
        clock = ClientClock(settings.header_timeout_s, settings.upload_stall_s, settings.min_bytes_per_s)
        self._settings = settings
        config = uvicorn.Config(
            self._application,
            factory=True,
            http=cast(Any, partial(GuardedProtocol, connections_held=self._connections, clock=clock)),
            ws="none",
            backlog=share.backlog,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,  # any client on loopback could choose the address that its requests count for
            lifespan="on",
            timeout_graceful_shutdown=_DRAIN_S,
        )
        super().__init__(config)

    def _application(self) -> FastAPI:
        return create_app(self._settings, connections=self._connections)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().set_exception_handler(self._note)
        await super().startup(sockets)
        sys.setswitchinterval(_SWITCH_S)
        _collect_seldom()

    def _note(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """The loop reports each connection that it cannot accept, with a traceback: make room instead."""
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in _EXHAUSTED:
            logger.warning("no descriptor for a new connection: connections that keep the server waiting are closed")
            self._connections.shed(_SHED)
        else:
            loop.default_exception_handler(context)


def _collect_seldom() -> None:
    """Thousands of connections are many objects: each full garbage collection stops every answer for .2 to .5 s.

    What is loaded by now stays for good and is left out.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_COLLECTIONS)

"""The API's process: `python -m regnf_cli.api_process FD` serves the application on a socket it is handed."""

from __future__ import annotations

import socket
import sys

import uvicorn

from regnf_state.logs import configure_logging
from regnf_state.settings import Settings

_APPLICATION = "regnf_service.app:create_app"
_DRAIN_S = 5
"""How long open requests may go on once the process is told to stop."""


def main(descriptor: int) -> None:
    configure_logging(Settings().log_format)
    config = uvicorn.Config(
        _APPLICATION,
        factory=True,
        log_config=None,
        access_log=False,
        server_header=False,
        lifespan="on",
        timeout_graceful_shutdown=_DRAIN_S,
    )
    server = uvicorn.Server(config)
    server.run(sockets=[socket.socket(fileno=descriptor)])
    if not server.started:
        sys.exit(3)


if __name__ == "__main__":
    main(int(sys.argv[1]))

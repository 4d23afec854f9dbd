"""The API's process: `python -m regnf_cli.api_process FD` serves the application on a socket it is handed."""

from __future__ import annotations

import gc
import socket
import sys


def main(descriptor: int) -> None:
    gc.disable()  # what loads stays; the server, once it has started, collects again
    from regnf_service.server import Server
    from regnf_state.logs import configure_logging
    from regnf_state.settings import Settings

    settings = Settings()
    configure_logging(settings.log_format)
    server = Server(settings)
    server.run(sockets=[socket.socket(fileno=descriptor)])
    if not server.started:
        sys.exit(3)


if __name__ == "__main__":
    main(int(sys.argv[1]))

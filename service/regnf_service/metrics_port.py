"""`/metrics` on a port of its own: for Prometheus, not for web pages, and with few connections at once."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import MetricsHandler

from regnf_service.http.hosts import AllowedHosts, parse_authority
from regnf_service.http.security_headers import SECURITY_HEADERS

_MOST_CONNECTIONS = 16
_SILENCE_S = 5.0
"""How long a scraper may send nothing, or read nothing."""
_LONGEST_S = 15.0
"""How long one scrape may take in all: who sends a byte now and then must not keep a connection for hours."""


@contextmanager
def served(registry: CollectorRegistry, hosts: AllowedHosts, host: str, port: int | None) -> Iterator[None]:
    """Answer scrapes while the context lasts; no port: not at all."""
    if port is None:
        yield
        return
    handler = type("_Handler", (_Handler,), {"registry": registry, "hosts": hosts})
    server = _Server((host, port), handler)
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(MetricsHandler):
    hosts: AllowedHosts
    timeout = _SILENCE_S

    def do_GET(self) -> None:  # noqa: N802 -- the base class dispatches by this name
        given = self.headers.get_all("Host") or []
        host = parse_authority(given[0]) if len(given) == 1 else None
        if host is None or not self.hosts.knows(host, str(self.connection.getsockname()[0])):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST, "Host not allowed: see REGNF_ALLOWED_HOSTS")
        elif self.headers.get("Origin") is not None or self.headers.get("Sec-Fetch-Site", "none") != "none":
            self.send_error(HTTPStatus.FORBIDDEN, "Origin not allowed")
        else:
            super().do_GET()

    def end_headers(self) -> None:
        for name, value in SECURITY_HEADERS.items():
            self.send_header(name, value)
        super().end_headers()


class _Server(ThreadingHTTPServer):
    """A thread a connection, and no more of them than a few: others are closed at once."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], handler: type[MetricsHandler]) -> None:
        found = socket.getaddrinfo(*address, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = found[0]
        self._slots = threading.BoundedSemaphore(_MOST_CONNECTIONS)
        super().__init__((str(found[4][0]), int(found[4][1])), handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._slots.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        ending = threading.Timer(_LONGEST_S, _cut_off, (request,))
        ending.daemon = True
        ending.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            ending.cancel()
            self._slots.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A scraper that leaves is no error of ours."""


def _cut_off(connection: socket.socket) -> None:
    """Whoever reads from or writes to the connection finds that it has ended."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)

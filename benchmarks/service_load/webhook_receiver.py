"""A receiver of webhooks that refuses for as long as it is told to, and notes what it has taken."""

from __future__ import annotations

import base64
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

SECRET = "whsec_" + base64.b64encode(bytes(range(32))).decode()


class WebhookReceiver:
    """Its addresses end in a number; ``taken`` counts the messages to each that were not refused."""

    def __init__(self) -> None:
        self.refuses = False
        self.refused = 0
        self.taken: Counter[int] = Counter()
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())

    @property
    def host(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}"

    def address(self, number: int) -> str:
        return f"{self.host}/{number}"

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                self.rfile.read(int(self.headers["Content-Length"]))
                if receiver.refuses:
                    receiver.refused += 1
                else:
                    receiver.taken[int(self.path.strip("/"))] += 1
                self.send_response(503 if receiver.refuses else 204)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Says nothing."""

        return Handler


@contextmanager
def receiving() -> Iterator[WebhookReceiver]:
    """A receiver that listens on loopback."""
    receiver = WebhookReceiver()
    thread = threading.Thread(target=receiver.server.serve_forever, daemon=True)
    thread.start()
    try:
        yield receiver
    finally:
        receiver.server.shutdown()
        thread.join()
        receiver.server.server_close()

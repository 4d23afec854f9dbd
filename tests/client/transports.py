"""Transports that count what is sent, and that break."""

from __future__ import annotations

from collections.abc import Callable

import httpx

Handler = Callable[[httpx.Request], httpx.Response]


class Counted(httpx.BaseTransport):
    """Hands requests on; knows what was sent. ``broken(request)``: whether this one never arrives."""

    def __init__(self, inner: httpx.BaseTransport, broken: Callable[[httpx.Request], bool] = lambda request: False):
        self._inner = inner
        self._broken = broken
        self.requests: list[tuple[str, str]] = []
        self.bodies: list[bytes] = []
        self.bytes = 0
        """Of all requests: lines, heads and bodies."""

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        body = request.read()
        head = sum(len(name) + len(value) + 4 for name, value in request.headers.raw)
        self.bytes += len(request.method) + len(request.url.raw_path) + 12 + head + len(body)
        self.requests.append((request.method, request.url.path))
        self.bodies.append(body)
        if self._broken(request):
            raise httpx.WriteError("the connection broke", request=request)
        return self._inner.handle_request(request)

    def close(self) -> None:
        self._inner.close()


class Pretended(httpx.BaseTransport):
    """Has a function answer."""

    def __init__(self, handler: Handler) -> None:
        self._handler = handler

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        request.read()
        return self._handler(request)

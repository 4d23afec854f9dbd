"""A blocking httpx client that calls an application directly, its event loop in a thread of its own."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from contextlib import ExitStack
from typing import Any, cast

import httpx
from anyio.from_thread import start_blocking_portal


class _BodyStream(httpx.AsyncByteStream):
    def __init__(self, pieces: Iterable[bytes]) -> None:
        self._pieces = pieces

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for piece in self._pieces:
            yield piece


class AppTransport(httpx.BaseTransport):
    """Hands requests to the application; what it raises becomes the answer its handlers make of it."""

    def __init__(self, app: Any) -> None:
        self._stack = ExitStack()
        self._portal = self._stack.enter_context(start_blocking_portal())
        self._inner = httpx.ASGITransport(app, raise_app_exceptions=False)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        return self._portal.call(self._handle, request)

    async def _handle(self, request: httpx.Request) -> httpx.Response:
        body = _BodyStream(cast(Iterable[bytes], request.stream))
        sent = httpx.Request(request.method, request.url, headers=request.headers, stream=body)
        answer = await self._inner.handle_async_request(sent)
        content = await answer.aread()
        return httpx.Response(answer.status_code, headers=answer.headers, content=content, request=request)

    def close(self) -> None:
        self._stack.close()


def client_of(app: Any, **options: Any) -> httpx.Client:
    return httpx.Client(transport=AppTransport(app), base_url="http://localhost", timeout=30, **options)

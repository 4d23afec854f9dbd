"""What every request passes on its way in: a request id, the token check, and headers that every answer bears."""

from __future__ import annotations

import hashlib
import hmac
import re
import uuid
from collections.abc import Iterable

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Problem, problem_response

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")
_OPEN_PATHS = re.compile(r"(/v1)?/healthz|/static/.*|(/v1)?/jobs/[A-Za-z0-9_-]+/view")


class RequestContext:
    """Gives each request its id, the caller's own if it is well formed, and writes it on every answer."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id

        async def send_marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                headers["X-Content-Type-Options"] = "nosniff"
                headers["Referrer-Policy"] = "no-referrer"
            await send(message)

        await self._app(scope, receive, send_marked)


def _is_open(scope: Scope) -> bool:
    """What needs no token: the liveness probe, and the page, which asks for the token itself."""
    return scope["method"] in ("GET", "HEAD") and _OPEN_PATHS.fullmatch(scope["path"]) is not None


class TokenGate:
    """Refuses every call without one of the tokens."""

    def __init__(self, app: ASGIApp, tokens: Iterable[str]) -> None:
        self._app = app
        # digests have one length, so that a comparison tells nothing about a token's
        self._digests = [hashlib.sha256(token.encode()).digest() for token in tokens]

    def _allows(self, authorization: str) -> bool:
        scheme, _, token = authorization.partition(" ")
        digest = hashlib.sha256(token.strip().encode("utf-8", "surrogateescape")).digest()
        matches = [hmac.compare_digest(digest, known) for known in self._digests]
        return scheme.lower() == "bearer" and any(matches)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        guarded = scope["type"] == "http" and bool(self._digests) and not _is_open(scope)
        if guarded and not self._allows(Headers(scope=scope).get("authorization", "")):
            problem = Problem("UNAUTHENTICATED", headers={"WWW-Authenticate": 'Bearer realm="regnf"'})
            await problem_response(problem, scope)(scope, receive, send)
        else:
            await self._app(scope, receive, send)

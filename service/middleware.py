"""What every request passes on its way in: a request id, the token check, and headers that every answer bears."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import uuid
from collections.abc import Iterable

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems import Problem, problem_response

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")
_OPEN_PATHS = re.compile(r"(/v1)?/healthz|/static/.*|(/v1)?/jobs/[A-Za-z0-9_-]+/view")
_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="regnf"'}
_NO_TOKENS = "Beyond loopback this service answers with tokens only, and none is configured."


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


def _came_from_outside(scope: Scope) -> bool:
    """Whether the connection arrived on an address that other machines reach. Names and Unix sockets are not such."""
    try:
        address = ipaddress.ip_address((scope.get("server") or ("",))[0] or "")
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return not (mapped or address).is_loopback


class TokenGate:
    """Refuses every call without one of the tokens.

    Without tokens it refuses what arrives from beyond loopback, unless ``allow_unauthenticated``: whichever server runs
    the application, wherever it was told to listen.
    """

    def __init__(self, app: ASGIApp, tokens: Iterable[str], allow_unauthenticated: bool = False) -> None:
        self._app = app
        self._allow_unauthenticated = allow_unauthenticated
        # digests have one length, so that a comparison tells nothing about a token's
        self._digests = [hashlib.sha256(token.encode()).digest() for token in tokens]

    def _allows(self, authorization: str) -> bool:
        scheme, _, token = authorization.partition(" ")
        digest = hashlib.sha256(token.strip().encode("utf-8", "surrogateescape")).digest()
        matches = [hmac.compare_digest(digest, known) for known in self._digests]
        return scheme.lower() == "bearer" and any(matches)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        problem = self._refusal(scope) if scope["type"] == "http" and not _is_open(scope) else None
        if problem is not None:
            await problem_response(problem, scope)(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Problem | None:
        detail = None
        if self._digests:
            refused = not self._allows(Headers(scope=scope).get("authorization", ""))
        else:
            refused = not self._allow_unauthenticated and _came_from_outside(scope)
            detail = _NO_TOKENS
        return Problem("UNAUTHENTICATED", detail, headers=_CHALLENGE) if refused else None

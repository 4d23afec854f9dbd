"""Keeps other web pages out: refuses what was sent under a foreign name, and what a browser sent for a foreign page.

Both work without tokens as well as with them. Programs send no `Origin` and no `Sec-Fetch-*`, so they notice nothing.
"""

from __future__ import annotations

import re

from starlette.datastructures import Headers
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from regnf_service.http.hosts import AllowedHosts, Authority, is_same_site, parse_authority, parse_origin
from regnf_service.http.problems import problem_response
from regnf_service.problem import Problem

_OWN_SITES = frozenset({"same-origin", "none"})
_PAGES = re.compile(r"(/v1)?(/docs|/jobs/[A-Za-z0-9_-]+/view|/|/jobs|/fields)")
"""What people follow a link to, from wherever they found it."""


class OriginGate:
    """Answers requests for a name that ``hosts`` knows, sent by a program or by a page of this service."""

    def __init__(self, app: ASGIApp, hosts: AllowedHosts, origins: frozenset[str] = frozenset()) -> None:
        self._app = app
        self._hosts = hosts
        self._origins = origins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            # there are none here; the framework would look at the route before it refused
            await receive()
            await send({"type": "websocket.close", "code": 1008})
        elif scope["type"] != "http":
            await self._app(scope, receive, send)
        elif (problem := self._refusal(scope)) is not None:
            await problem_response(problem, scope)(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Problem | None:
        headers = Headers(scope=scope)
        if "transfer-encoding" in headers and "content-length" in headers:
            # a proxy in front may see the body's end at another place than this server
            return Problem("INVALID_HEADER", "The body has two different lengths.", headers={"Connection": "close"})
        given = headers.getlist("host")
        host = parse_authority(given[0]) if len(given) == 1 and scope["path"].startswith("/") else None
        arrived_on = (scope.get("server") or ("",))[0] or ""
        if host is None or not self._hosts.knows(host, arrived_on):
            return Problem("HOST_NOT_ALLOWED")
        if self._is_named(headers) or _is_visit(scope, headers) or not _is_foreign(headers, host):
            return None
        return Problem("ORIGIN_NOT_ALLOWED")

    def _is_named(self, headers: Headers) -> bool:
        """Whether the page behind the request is of a site that the operator has named (``origins``)."""
        given = headers.getlist("origin")
        return len(given) == 1 and given[0] in self._origins


def _is_foreign(headers: Headers, host: Authority) -> bool:
    """Whether a page of another site is behind the request. What cannot be read is foreign."""
    origins = [parse_origin(text) for text in headers.getlist("origin")]
    if any(origin is None or not is_same_site(origin, host) for origin in origins):
        return True
    return any(site.lower() not in _OWN_SITES for site in headers.getlist("sec-fetch-site"))


def _is_visit(scope: Scope, headers: Headers) -> bool:
    """Whether somebody followed a link to one of the pages, which then fills a window of its own."""
    return (
        scope["method"] in ("GET", "HEAD")
        and headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest") == "document"
        and "origin" not in headers
        and _PAGES.fullmatch(scope["path"]) is not None
    )


# Pages of other sites that the operator has named may call the service (CORS). Without a list none may.

_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
_ASKED = (
    "Authorization", "Content-Type", "Content-Digest", "Content-Range", "Idempotency-Key", "If-None-Match",
    "Last-Event-ID", "Prefer", "Range", "X-Request-ID",
)  # fmt: skip
_TOLD = ("Content-Range", "ETag", "Location", "Retry-After", "WWW-Authenticate", "X-Request-ID")


def cors_layer(origins: frozenset[str]) -> list[Middleware]:
    """Answers what browsers ask before a call, and lets those pages read the answers. No cookies are involved."""
    if not origins:
        return []
    return [
        Middleware(
            CORSMiddleware,
            allow_origins=sorted(origins),
            allow_methods=_METHODS,
            allow_headers=_ASKED,
            expose_headers=_TOLD,
        )
    ]

"""Keeps other web pages out: refuses what was sent under a foreign name, and what a browser sent for a foreign page.

Both work without tokens as well as with them. Programs send no `Origin` and no `Sec-Fetch-*`, so they notice nothing.
"""

from __future__ import annotations

import re

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from regnf_service.http.hosts import AllowedHosts, Authority, is_same_site, parse_authority, parse_origin
from regnf_service.http.problems import problem_response
from regnf_service.problem import CLOSE, Problem

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
        given = headers.getlist("host")
        host = parse_authority(given[0]) if len(given) == 1 and scope["path"].startswith("/") else None
        arrived_on = (scope.get("server") or ("",))[0] or ""
        if host is None or not self._hosts.knows(host, arrived_on):
            return Problem("HOST_NOT_ALLOWED", headers=CLOSE)
        if self._is_named(headers) or _is_visit(scope, headers) or not _is_foreign(headers, host):
            return None
        return Problem("ORIGIN_NOT_ALLOWED", headers=CLOSE)

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

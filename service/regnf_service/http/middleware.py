"""What every request passes first: a request id, the token check, and headers that every answer has."""

from __future__ import annotations

import ipaddress
import logging
import re
import time
import uuid

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from regnf_service.http.open_paths import OPEN_PATHS
from regnf_service.http.page_requests import is_home_page
from regnf_service.http.problems import problem_response
from regnf_service.http.security_headers import secure
from regnf_service.http.wrong_tokens import WrongTokens
from regnf_service.problem import CLOSE, Problem
from regnf_state.logs import ACCESS_LOGGER, log_context
from regnf_state.ownership import ANONYMOUS

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")
_JOB_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_PROBES = frozenset({"/healthz", "/readyz", "/static"})
access_log = logging.getLogger(ACCESS_LOGGER)
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
        began, status = time.perf_counter(), 500

        async def send_marked(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                secure(headers)
            await send(message)

        with log_context(request_id=request_id):
            try:
                await self._app(scope, receive, send_marked)
            finally:
                _log_access(scope, status, time.perf_counter() - began)


def _log_access(scope: Scope, status: int, seconds: float) -> None:
    """One entry a request: its route, never the address with whatever a client put there."""
    route = route_of(scope)
    job_id = scope.get("path_params", {}).get("id", "")
    told = {
        "method": scope["method"] if scope["method"].isalpha() else "other",
        "route": route,
        "status": status,
        "seconds": round(seconds, 4),
        "caller": scope["state"].get("caller"),
        "job_id": job_id if _JOB_ID.fullmatch(job_id) else None,
    }
    level = logging.DEBUG if route in _PROBES else logging.INFO
    access_log.log(level, "%s %s %d", told["method"], route, status, extra=told)


def route_of(scope: Scope) -> str:
    """The template of the route that answered, without the prefix; "other" where none did."""
    if scope["path"].startswith("/static/"):
        return "/static"
    template = str(getattr(scope.get("route"), "path", "")) or "other"
    return template.removeprefix("/v1") or "/"


def is_open(scope: Scope) -> bool:
    """What needs no token: the liveness probe, and the pages, which ask for the token themselves."""
    open_path = OPEN_PATHS.fullmatch(scope["path"]) is not None
    return scope["method"] in ("GET", "HEAD") and (open_path or is_home_page(scope))


def _came_from_outside(scope: Scope) -> bool:
    """Whether the connection arrived on an address that other machines reach. Names and Unix sockets are not such."""
    try:
        address = ipaddress.ip_address((scope.get("server") or ("",))[0] or "")
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return not (mapped or address).is_loopback


class TokenGate:
    """Refuses every call without an ``owner`` in its state, and tells whose it was: ``caller`` in the request's state.

    Without tokens it refuses what arrives from beyond loopback, unless ``allow_unauthenticated``: whichever server runs
    the application, wherever it was told to listen.
    """

    def __init__(self, app: ASGIApp, needs_token: bool, allow_unauthenticated: bool = False) -> None:
        self._app = app
        self._needs_token = needs_token
        self._allow_unauthenticated = allow_unauthenticated
        self._wrong = WrongTokens()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        caller = ANONYMOUS
        if self._needs_token:
            owner = scope["state"]["owner"]
            caller, known = owner or ANONYMOUS, owner is not None
        else:
            known = self._allow_unauthenticated or not _came_from_outside(scope)
        scope["state"]["caller"] = caller
        problem = None if known or is_open(scope) else self._refusal(scope)
        with log_context(caller=caller):
            if problem is not None:
                await problem_response(problem, scope)(scope, receive, send)
            else:
                await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Problem:
        if self._needs_token and "authorization" in Headers(scope=scope) and (wait := self._wrong.wait_s(scope)):
            return Problem("TOO_MANY_WRONG_TOKENS", headers={"Retry-After": str(wait)} | CLOSE)
        return Problem("UNAUTHENTICATED", None if self._needs_token else _NO_TOKENS, headers=_CHALLENGE)

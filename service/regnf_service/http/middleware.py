"""What every request passes first: a request id, the token check, and headers that every answer has."""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from collections import Counter, OrderedDict, deque
from collections.abc import Callable

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from regnf_service.concurrency import Slots, whose
from regnf_service.http.problems import OPEN_PATHS, problem_response, secure
from regnf_service.http.query import is_home_page
from regnf_service.problem import RETRY_LATER, Problem
from regnf_service.tokens import Callers, caller_of
from regnf_state.logs import ACCESS_LOGGER, log_context
from regnf_state.ownership import ANONYMOUS
from regnf_state.settings import address_of

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")
_JOB_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_PROBES = frozenset({"/healthz", "/readyz", "/static"})
access_log = logging.getLogger(ACCESS_LOGGER)
_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="regnf"'}
_NO_TOKENS = "This service has no access tokens, so it accepts only requests from this machine."


class RequestContext:
    """Gives each request its id, the caller's own if it is well formed, and writes it on every answer.

    ``count`` is called for each: its scope, status, seconds until the response began, and bytes of its body.
    """

    def __init__(self, app: ASGIApp, count: Callable[[Scope, int, float, int], None]) -> None:
        self._app = app
        self._count = count

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if _REQUEST_ID.fullmatch(given) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id
        began, status, received = time.perf_counter(), 500, 0
        answered: float | None = None

        async def receive_counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            return message

        async def send_marked(message: Message) -> None:
            nonlocal status, answered
            if message["type"] == "http.response.start":
                status, answered = message["status"], time.perf_counter()
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                secure(headers)
            await send(message)

        with log_context(request_id=request_id):
            try:
                await self._app(scope, receive_counted, send_marked)
            finally:
                ended = time.perf_counter()
                self._count(scope, status, (answered or ended) - began, received)
                _log_access(scope, status, ended - began)


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
    address = address_of((scope.get("server") or ("",))[0] or "")
    return address is not None and not address.is_loopback


class TokenGate:
    """Refuses every call without an ``owner`` in its state, and tells whose it was: ``caller`` in the request's state.

    Without tokens it refuses what arrives from beyond loopback, unless ``allow_unauthenticated``: whichever server runs
    the application, wherever it was told to listen.
    """

    def __init__(self, app: ASGIApp, needs_token: bool, allow_unauthenticated: bool = False) -> None:
        self._app = app
        self._needs_token = needs_token
        self._allow_unauthenticated = allow_unauthenticated

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
        with log_context(caller=caller):
            if known or is_open(scope):
                await self._app(scope, receive, send)
            else:
                problem = Problem("UNAUTHENTICATED", None if self._needs_token else _NO_TOKENS, headers=_CHALLENGE)
                await problem_response(problem, scope)(scope, receive, send)


# In which order requests begin when more come in than can be answered at once, and how many of a caller go on.
#
# A few begin in each turn of the event loop, and callers take turns.

AT_ONCE = 4
"""In one turn of the event loop: a turn in which thousands of slow clients are read takes milliseconds."""


def fair_key(scope: Scope, caller: str) -> str:
    """Who counts as one: a caller, or an address where no token says whose the request is.

    A caller's name has no space in it, so that no caller is taken for an address.
    """
    return caller if caller != ANONYMOUS else f"{ANONYMOUS} {(scope.get('client') or ('',))[0]}"


class Turns:
    """For one event loop."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()
        self._is_taken = False

    async def come(self, who: str) -> None:
        """Return when it is the turn of ``who``."""
        loop = asyncio.get_running_loop()
        if not self._is_taken:
            self._is_taken = True
            loop.call_soon(self._next)
            return
        turn = loop.create_future()
        self._waiting.setdefault(who, deque()).append(turn)
        await turn

    def _next(self) -> None:
        begun = 0
        while self._waiting and begun < AT_ONCE:
            who, waiting = self._waiting.popitem(last=False)
            turn = waiting.popleft()
            if waiting:
                self._waiting[who] = waiting
            if not turn.done():
                turn.set_result(None)
                begun += 1
        if begun:
            asyncio.get_running_loop().call_soon(self._next)
        else:
            self._is_taken = False


class TurnGate:
    """Lets each request wait for its turn, and tells whose token it has: ``owner`` in the request's state, or None."""

    def __init__(self, app: ASGIApp, callers: Callers) -> None:
        self._app = app
        self._callers = callers
        self._turns = Turns()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            state = scope.setdefault("state", {})
            owner = caller_of(self._callers, Headers(scope=scope).get("authorization", ""))
            state["owner"] = owner
            who = fair_key(scope, owner or ANONYMOUS)
            whose.set(who)
            await self._turns.come(who)
        await self._app(scope, receive, send)


_BLOCK_BYTES = 64 * 1024
"""Of an answer, that is handed to the connection at once."""
_MOST_UNREAD = 16 * 1024 * 1024
"""Bytes of answers of one caller that wait to be read, blocks aside that the connections have already."""


class RequestGate:
    """Refuses the requests of a caller that has ``slots`` of them in progress, before any of them waits for a thread,
    and the answers to a caller that leaves very many unread. What is answered is sent in blocks: the server takes the
    next one when its client has read enough, so a connection holds no more than a block or two.

    Where no token is requested, an address counts as a caller. The slots are not for what needs no token elsewhere.
    """

    def __init__(self, app: ASGIApp, slots: Slots) -> None:
        self._app = app
        self._slots = slots
        self._unread: Counter[str] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        who = fair_key(scope, scope["state"]["caller"])
        held: list[str] = []
        if not is_open(scope):
            try:
                self._slots.take(who)
            except Problem as problem:
                await problem_response(problem, scope)(scope, receive, send)
                return
            held.append(who)
        refused = False

        def free() -> None:
            while held:
                self._slots.free(held.pop())

        async def send_in_blocks(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start" and self._unread[who] > _MOST_UNREAD:
                refused = True
                detail = "Too many response bytes are waiting to be read. Read them, then repeat the request."
                problem = Problem("TOO_MANY_REQUESTS_AT_ONCE", detail, headers=RETRY_LATER)
                await problem_response(problem, scope)(scope, receive, send)
            if refused:
                return
            if message["type"] == "http.response.body" and not message.get("more_body", False):
                free()  # whether its client reads the answer is not the caller's next request's concern
            if message.get("body"):
                await self._send_body(who, message, send)
            else:
                await send(message)

        try:
            await self._app(scope, receive, send_in_blocks)
        finally:
            free()

    async def _send_body(self, who: str, message: Message, send: Send) -> None:
        body: bytes = message["body"]
        left = len(body)
        self._unread[who] += left
        try:
            for begin in range(0, len(body), _BLOCK_BYTES):
                block = body[begin : begin + _BLOCK_BYTES]
                more = message.get("more_body", False) or len(block) < left
                await send({"type": message["type"], "body": block, "more_body": more})
                self._unread[who] -= len(block)
                left -= len(block)
                if left:
                    await asyncio.sleep(0)  # so that a connection that is lost is noticed before the next block
        finally:
            self._unread[who] -= left
            if not self._unread[who]:
                del self._unread[who]

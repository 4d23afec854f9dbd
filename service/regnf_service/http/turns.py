"""In which order requests begin when more come in than can be answered at once, and how many of a caller go on.

A few begin in each turn of the event loop. Callers take turns. Of one caller the connection goes first that was
answered longest ago: who asks now and then is not behind connections that ask without a pause, or are made anew.
"""

from __future__ import annotations

import asyncio
import heapq
from collections import OrderedDict
from itertools import count

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from regnf_service.concurrency import Slots, whose
from regnf_service.http.connections import site_of
from regnf_service.http.middleware import is_open
from regnf_service.http.problems import problem_response
from regnf_service.problem import Problem
from regnf_service.tokens import Callers, caller_of
from regnf_state.ownership import ANONYMOUS

AT_ONCE = 4
"""In one turn of the event loop: a turn in which thousands of slow clients are read takes milliseconds."""
_Waiting = list[tuple[float, int, asyncio.Future[None]]]


def fair_key(scope: Scope, caller: str) -> str:
    """Who counts as one: a caller, or an address where no token says whose the request is.

    A caller's name has no space in it, so that no caller is taken for an address.
    """
    return caller if caller != ANONYMOUS else f"{ANONYMOUS} {site_of((scope.get('client') or ('',))[0])}"


class Turns:
    """For one event loop."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, _Waiting] = OrderedDict()
        self._numbers = count()
        self._is_taken = False

    async def come(self, who: str, quiet_since: float) -> None:
        """Return when it is the turn of a connection of ``who`` that has been quiet since that time."""
        loop = asyncio.get_running_loop()
        if not self._is_taken:
            self._is_taken = True
            loop.call_soon(self._next)
            return
        turn = loop.create_future()
        heapq.heappush(self._waiting.setdefault(who, []), (quiet_since, next(self._numbers), turn))
        await turn

    def _next(self) -> None:
        begun = 0
        while self._waiting and begun < AT_ONCE:
            who, waiting = self._waiting.popitem(last=False)
            _, _, turn = heapq.heappop(waiting)
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
            connection = state.get("connection")  # the server's own; another server tells nothing
            quiet_since = asyncio.get_running_loop().time() if connection is None else connection.quiet_since
            who = fair_key(scope, owner or ANONYMOUS)
            whose.set(who)
            await self._turns.come(who, quiet_since)
        await self._app(scope, receive, send)


class RequestGate:
    """Refuses the requests of a caller that has ``slots`` of them in progress, before any of them waits for a thread.

    Each uses a connection that cannot be closed for others.

    Where no token is asked for, an address counts as a caller. What needs no token elsewhere is not counted.
    """

    def __init__(self, app: ASGIApp, slots: Slots) -> None:
        self._app = app
        self._slots = slots

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or is_open(scope):
            await self._app(scope, receive, send)
            return
        who = fair_key(scope, scope["state"]["caller"])
        try:
            self._slots.take(who)
        except Problem as problem:
            await problem_response(problem, scope)(scope, receive, send)
            return
        held = [who]

        def free() -> None:
            while held:
                self._slots.free(held.pop())

        async def send_last(message: Message) -> None:
            if message["type"] == "http.response.body" and not message.get("more_body", False):
                free()  # whether its client reads the answer is not the caller's next request's concern
            await send(message)

        try:
            await self._app(scope, receive, send_last)
        finally:
            free()

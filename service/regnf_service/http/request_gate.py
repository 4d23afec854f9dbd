"""How many requests of a caller may be in progress at once: each uses a connection that cannot be closed for others."""

from __future__ import annotations

from starlette.types import ASGIApp, Receive, Scope, Send

from regnf_service.concurrency import Slots
from regnf_service.http.connections import site_of
from regnf_service.http.middleware import is_open
from regnf_service.http.problems import problem_response
from regnf_service.problem import Problem
from regnf_state.ownership import ANONYMOUS


class RequestGate:
    """Refuses the requests of a caller that has ``slots`` of them in progress, before any of them waits for a thread.

    Where no token is asked for, an address counts as a caller. What needs no token elsewhere is not counted.
    """

    def __init__(self, app: ASGIApp, slots: Slots) -> None:
        self._app = app
        self._slots = slots

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or is_open(scope):
            await self._app(scope, receive, send)
            return
        who = _who(scope)
        try:
            self._slots.take(who)
        except Problem as problem:
            await problem_response(problem, scope)(scope, receive, send)
            return
        try:
            await self._app(scope, receive, send)
        finally:
            self._slots.free(who)


def _who(scope: Scope) -> str:
    """A caller's name has no space in it, so that no caller is taken for an address."""
    caller = str(scope["state"]["caller"])
    return caller if caller != ANONYMOUS else f"{ANONYMOUS} {site_of((scope.get('client') or ('',))[0])}"

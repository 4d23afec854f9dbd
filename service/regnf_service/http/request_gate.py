"""How many requests of a caller may be in progress at once: each uses a connection that cannot be closed for others."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from regnf_service.concurrency import Slots
from regnf_service.http.middleware import is_open
from regnf_service.http.problems import problem_response
from regnf_service.http.turns import fair_key
from regnf_service.problem import Problem


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

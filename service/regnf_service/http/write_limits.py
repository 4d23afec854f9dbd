"""How often a caller may ask for a change. Each costs the front end much more time than its refusal does.

It is counted in the memory of this process, before anything is read: neither the body nor Redis. What is kept free here
is the time of this very process, so that several front ends need not agree.
"""

from __future__ import annotations

import asyncio
import math

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from regnf_service.http.buckets import Buckets
from regnf_service.http.problems import problem_response
from regnf_service.http.turns import fair_key
from regnf_service.problem import CLOSE, Problem

_READS = frozenset({"GET", "HEAD", "OPTIONS"})
_LONGEST_WAIT_S = 3600.0
_REFUSALS_PER_S, _REFUSALS = 20.0, 20.0
_HELD_S = 2.0
"""Beyond those. A hundred connections of a caller then take 70 refusals a second, not all the time of the process."""
_SMALL_BYTES = 65536
"""A body that is dropped as it arrives. What is larger is not worth the connection."""


class WriteGate:
    """Refuses the requests of a caller whose bucket is empty, unless they are reads.

    Where no token is asked for, an address counts as a caller. Refusals take time, too: a caller who asks again at once
    gets them later.
    """

    def __init__(self, app: ASGIApp, buckets: Buckets) -> None:
        self._app = app
        self._buckets = buckets
        self._refusals = Buckets(_REFUSALS_PER_S, _REFUSALS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        wait_s = 0.0
        if scope["type"] == "http" and scope["method"] not in _READS:
            who = fair_key(scope, scope["state"]["caller"])
            wait_s = self._buckets.take(who)
            if wait_s and self._refusals.take(who):
                await asyncio.sleep(_HELD_S)
        if wait_s:
            headers = {"Retry-After": str(math.ceil(min(wait_s, _LONGEST_WAIT_S)))}
            problem = Problem("TOO_MANY_WRITES", headers=headers if _has_small_body(scope) else headers | CLOSE)
            await problem_response(problem, scope)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


def _has_small_body(scope: Scope) -> bool:
    """Whether the connection can go on: the server reads what is left of the body, and nobody waits to send it."""
    headers = Headers(scope=scope)
    length = headers.get("content-length", "0")
    return (
        "transfer-encoding" not in headers
        and "expect" not in headers
        and length.isdecimal()
        and len(length) < 10
        and int(length) <= _SMALL_BYTES
    )

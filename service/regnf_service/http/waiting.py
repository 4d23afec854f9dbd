"""Holding an answer back until there is news, without holding a thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from regnf_service.concurrency import LOOKS, in_thread, pause
from regnf_service.services import Services

_FIRST_PAUSE_S = 0.02
_MAX_PAUSE_S = 0.25
_Value = TypeVar("_Value")


async def wait_for(
    fetch: Callable[[], _Value], enough: Callable[[_Value], bool], seconds: float, services: Services, caller: str
) -> _Value:
    """What ``fetch`` (blocking) returns once it is ``enough``, ``seconds`` have passed or the service stops.

    At once where very many wait already, or many of this caller.
    """
    deadline = time.monotonic() + (seconds if services.waiters.has_room(caller) else 0.0)
    step = _FIRST_PAUSE_S
    with services.waiters.held(caller):
        value = await in_thread(fetch)
        while True:
            left = deadline - time.monotonic()
            if enough(value) or left <= 0:
                return value
            if await pause(min(services.waiters.pause_s(caller, step), left), services.stopping):
                return value
            value = await LOOKS.run(fetch)
            step = min(step * 1.5, _MAX_PAUSE_S)

"""How fast a client sends a body, and the time that it has for it."""

from __future__ import annotations

import asyncio
import time

from starlette.requests import Request
from starlette.types import Message

from regnf_service.problem import CLOSE, Problem
from regnf_state.settings import Settings


class Pace:
    """Of one body. Only time spent waiting for the client counts."""

    def __init__(self, settings: Settings) -> None:
        self._stall_s = settings.upload_stall_s
        self._bytes_per_s = settings.min_bytes_per_s
        self._received = 0
        self._waited = 0.0
        self._since: float | None = None
        self._limit: asyncio.Timeout | None = None
        self._is_cut = False

    def behind_s(self) -> float:
        """By how much the body is later than the slowest that is taken for long; negative: earlier."""
        waiting = 0.0 if self._since is None else time.monotonic() - self._since
        return self._waited + waiting - self._received / self._bytes_per_s

    def cut(self) -> None:
        """End it as if it had stalled."""
        self._is_cut = True
        if self._limit is not None and not self._limit.expired():
            self._limit.reschedule(asyncio.get_running_loop().time())

    async def next(self, request: Request) -> Message:
        """What comes next. Raises Problem UPLOAD_STALLED when nothing comes for long, or too little."""
        left = 0.0 if self._is_cut else min(self._stall_s, max(0.0, self._stall_s - self.behind_s()))
        self._since = time.monotonic()
        try:
            async with asyncio.timeout(left) as self._limit:
                message = await request.receive()
        except TimeoutError as error:
            raise Problem("UPLOAD_STALLED", headers=CLOSE) from error
        finally:
            self._waited += time.monotonic() - self._since
            self._since = self._limit = None
        self._received += len(message.get("body", b""))
        return message

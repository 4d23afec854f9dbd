"""Answers that come late, and in another order than they were asked for."""

from __future__ import annotations

import time

from playwright.sync_api import APIResponse, Page, Route

_WAIT_S = 30


class Held:
    """What the service answers at once to requests of a pattern reaches the page only when it is let through."""

    def __init__(self, page: Page, pattern: str) -> None:
        self._page = page
        self._held: list[tuple[Route, APIResponse]] = []
        page.route(pattern, self._hold)
        self.pattern = pattern

    def _hold(self, route: Route) -> None:
        self._held.append((route, route.fetch()))

    def wait(self, count: int = 1) -> None:
        """Until so many answers are held."""
        end = time.monotonic() + _WAIT_S
        while len(self._held) < count:
            assert time.monotonic() < end, f"{len(self._held)} of {count} answers to {self.pattern}"
            self._page.wait_for_timeout(20)  # has the browser's messages come in

    def let(self, place: int = 0) -> None:
        """Let one answer through."""
        route, answer = self._held.pop(place)
        route.fulfill(response=answer)

    def end(self) -> None:
        """Let all through, and hold no more."""
        while self._held:
            self.let()
        self._page.unroute(self.pattern)

"""When a request is sent again, and after how long."""

from __future__ import annotations

import random
from dataclasses import dataclass

import httpx

_PASSING = frozenset(
    {"RATE_LIMITED", "TOO_MANY_WRITES", "TOO_MANY_REQUESTS_AT_ONCE", "TOO_MANY_UPLOADS", "ARTIFACT_NOT_READY"}
)
"""Refusals that time mends by itself. Quotas are told at once: they may last for hours."""
_PASSING_STATUSES = frozenset({409, 429})
_AWAY = frozenset({502, 503, 504})
_SPREAD = 2.0
"""So that many that were refused together do not ask together ever after."""


@dataclass(frozen=True)
class Patience:
    """total_s: the most seconds that the service's own `Retry-After` may cost one request · retries: how often it is
    sent again after a broken connection or a 502, 503, 504 · first_s: the pause before the first of these; each one is
    twice as long as the one before."""

    total_s: float = 120.0
    retries: int = 4
    first_s: float = 0.25

    def tries(self) -> Tries:
        """Of one request."""
        return Tries(self)


class Tries:
    """What is left of the patience for one request."""

    def __init__(self, patience: Patience) -> None:
        self._left_s = patience.total_s
        self._retries = patience.retries
        self._next_s = patience.first_s

    def wait_s(self, answer: httpx.Response | httpx.RequestError) -> float | None:
        """How long to wait before the same is asked again; None if that is of no use any more."""
        if isinstance(answer, httpx.Response):
            after = _retry_after_s(answer)
            if answer.status_code in _PASSING_STATUSES:
                return None if after is None or _reason(answer) not in _PASSING else self._spend(after)
            if answer.status_code not in _AWAY:
                return None
        else:
            after = None
            if not isinstance(answer, httpx.TransportError) or isinstance(answer, httpx.UnsupportedProtocol):
                return None
        if self._retries <= 0:
            return None
        self._retries -= 1
        wait_s, self._next_s = self._next_s, 2 * self._next_s
        return self._spend(max(wait_s / _SPREAD, after or 0.0))

    def _spend(self, seconds: float) -> float | None:
        wait_s = seconds * random.uniform(1.0, _SPREAD)  # noqa: S311
        if wait_s > self._left_s:
            return None
        self._left_s -= wait_s
        return wait_s


def _retry_after_s(answer: httpx.Response) -> float | None:
    text = answer.headers.get("retry-after", "")
    return float(text) if text.isascii() and text.isdecimal() else None


def _reason(answer: httpx.Response) -> str | None:
    try:
        problem = answer.json()
    except ValueError:
        return None
    return problem.get("reason") if isinstance(problem, dict) else None

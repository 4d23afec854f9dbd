"""An HTTP client that obeys a service which says that it is asked too fast."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

import httpx

_PASSING = frozenset({"RATE_LIMITED", "TOO_MANY_WRITES", "TOO_MANY_REQUESTS_AT_ONCE", "TOO_MANY_UPLOADS"})
"""Refusals that time mends by itself. Quotas are told at once: they may last for hours."""
_PATIENCE_S = 120.0
_SPREAD = 2.0


class PatientClient(httpx.Client):
    """Asks again after the seconds of `Retry-After`, for two minutes at most; then the refusal is the answer.

    Up to twice the seconds, so that many that were refused together do not ask together ever after. The body of a
    request must be one that can be sent again.
    """

    def __init__(self, *, sleep: Callable[[float], None] = time.sleep, **options: Any) -> None:
        super().__init__(**options)
        self._sleep = sleep

    def send(self, request: httpx.Request, **how: Any) -> httpx.Response:
        """The answer that is no such refusal, or the last one."""
        patience_s = _PATIENCE_S
        while True:
            answer = super().send(request, **how)
            wait_s = _wait_s(answer)
            if wait_s is None or wait_s > patience_s:
                return answer
            patience_s -= wait_s
            self._sleep(wait_s)


def _wait_s(answer: httpx.Response) -> float | None:
    """How long to wait before the same is asked again; None if that is of no use."""
    after = answer.headers.get("retry-after", "")
    if answer.status_code != httpx.codes.TOO_MANY_REQUESTS or not (after.isascii() and after.isdecimal()):
        return None
    answer.read()
    try:
        problem = answer.json()
    except ValueError:
        return None
    if not isinstance(problem, dict) or problem.get("reason") not in _PASSING:
        return None
    return float(after) * random.uniform(1.0, _SPREAD)  # noqa: S311

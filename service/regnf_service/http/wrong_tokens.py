"""How many wrong tokens an address may send: a bucket for each in memory, and no more buckets than a few thousand.

A right token is always taken, whatever else its address has sent: behind a proxy all callers share one, and a guesser
must not lock them out. Hence this does not keep guesses from being looked at. It answers them with 429 and ends their
connections. That tokens cannot be guessed is due to their length.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from starlette.types import Scope

from regnf_service.http.buckets import Buckets
from regnf_service.http.connections import site_of

_BURST = 20.0
_PER_S = 0.2


class WrongTokens:
    """For one process."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._sites = Buckets(_PER_S, _BURST, clock)
        self.count = 0

    def wait_s(self, scope: Scope) -> int:
        """Count a wrong token of this request: 0, or the seconds that its sender should wait."""
        self.count += 1
        return math.ceil(self._sites.take(site_of((scope.get("client") or ("",))[0])))

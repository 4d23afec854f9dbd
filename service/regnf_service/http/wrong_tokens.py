"""How many wrong tokens an address may send: a bucket for each in memory, and no more buckets than a few thousand.

A right token is always taken, whatever else its address has sent: behind a proxy all callers share one, and a guesser
must not lock them out. Hence this does not keep guesses from being looked at. It answers them with 429 and ends their
connections. That tokens cannot be guessed is due to their length.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable

from starlette.types import Scope

from regnf_service.http.connections import site_of

_BURST = 20.0
_PER_S = 0.2
_MOST_SITES = 4096


class WrongTokens:
    """For one process."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._sites: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """What is left in the bucket, and when that was so; the address that was quiet longest comes first."""
        self.count = 0

    def wait_s(self, scope: Scope) -> int:
        """Count a wrong token of this request: 0, or the seconds that its sender should wait."""
        self.count += 1
        site, now = site_of((scope.get("client") or ("",))[0]), self._clock()
        left, at = self._sites.pop(site, (_BURST, now))
        left = min(_BURST, left + (now - at) * _PER_S)
        wait = 0 if left >= 1 else math.ceil((1 - left) / _PER_S)
        self._sites[site] = (left if wait else left - 1, now)
        if len(self._sites) > _MOST_SITES:
            self._sites.popitem(last=False)
        return wait

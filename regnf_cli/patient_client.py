"""An HTTP client that obeys a service which says that it is asked too fast, or that a file is still to come."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import httpx

from regnf_client.patience import Patience


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
        tries = Patience(retries=0).tries()
        while True:
            answer = super().send(request, **how)
            if answer.is_error:
                answer.read()
            wait_s = tries.wait_s(answer)
            if wait_s is None:
                return answer
            self._sleep(wait_s)

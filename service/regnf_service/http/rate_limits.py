"""How often a caller may call: a bucket of tokens for each, kept in Redis, so that it holds across processes."""

from __future__ import annotations

import math

from redis import Redis
from redis.exceptions import RedisError
from starlette.types import ASGIApp, Receive, Scope, Send

from regnf_service.concurrency import in_thread
from regnf_service.http.middleware import is_open
from regnf_service.http.problems import problem_response
from regnf_service.problem import Problem
from regnf_state.redis.documents import text
from regnf_state.redis.unreadable import PREFIX

# The server's clock, so that processes need not agree on one; a step back of it refills nothing and costs nothing.
_TAKE = """
local time = redis.call('TIME')
local now, rate, burst = time[1] + time[2] / 1e6, tonumber(ARGV[1]), tonumber(ARGV[2])
local held = redis.call('HMGET', KEYS[1], 'tokens', 'at')
local tokens = tonumber(held[1]) or burst
tokens = math.min(burst, tokens + math.max(0, now - (tonumber(held[2]) or now)) * rate)
local wait = 0
if tokens >= 1 then tokens = tokens - 1 else wait = (1 - tokens) / rate end
redis.call('HSET', KEYS[1], 'tokens', tostring(tokens), 'at', string.format('%.6f', now))
redis.call('PEXPIRE', KEYS[1], math.ceil(1000 * burst / rate) + 1000)
return tostring(wait)
"""


class RateLimiter:
    """A bucket of ``burst`` calls for each caller that fills by ``rate`` calls a second."""

    def __init__(self, redis: Redis, rate: float, burst: int) -> None:
        self._take = redis.register_script(_TAKE)
        self._rate = rate
        self._burst = burst

    def take(self, caller: str) -> float:
        """Count one call: 0.0 when it may go ahead, otherwise the seconds until one may."""
        answer: bytes | str = self._take(keys=[f"{PREFIX}rate:{caller}"], args=[self._rate, self._burst])
        return float(text(answer))


class RateGate:
    """Refuses the calls of a caller whose bucket is empty. What needs no token is not counted."""

    def __init__(self, app: ASGIApp, limiter: RateLimiter) -> None:
        self._app = app
        self._limiter = limiter

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        wait = 0.0
        if scope["type"] == "http" and not is_open(scope):
            try:
                wait = await in_thread(self._limiter.take, scope["state"]["caller"])
            except RedisError:
                wait = 0.0  # whatever the call needs of Redis will say that it is away
        if wait > 0:
            problem = Problem("RATE_LIMITED", headers={"Retry-After": str(math.ceil(wait))})
            await problem_response(problem, scope)(scope, receive, send)
        else:
            await self._app(scope, receive, send)

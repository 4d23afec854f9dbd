"""How workers and tools talk to Redis: explicit time limits, health checks, retries with back-off.

The API has a client of its own, whose calls end sooner: regnf_state.redis.bounded_client.
"""

from __future__ import annotations

from urllib.parse import quote, urlsplit, urlunsplit

from redis import Redis
from redis.backoff import ExponentialWithJitterBackoff
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry

from regnf_state.settings import Settings

SOCKET_TIMEOUT_S = 10.0
RETRIES = 6
"""About four seconds in all, where a server refuses connections; each attempt at one that is silent takes ten."""
WORKER_RETRIES = 20
"""A worker has nothing else to do: some twenty seconds, in which a Redis that was started with it comes up."""


def connect(url: str, *, retries: int = RETRIES, socket_timeout_s: float = SOCKET_TIMEOUT_S) -> Redis:
    """A client for redis://, rediss:// or unix:// addresses. Connects on first use.

    A command is tried again ``retries`` times. Every script of ours may be
    repeated without harm. The socket's time limit is stated because the library's own is shorter than some waits.
    """
    return Redis.from_url(
        url,
        socket_timeout=socket_timeout_s,
        socket_connect_timeout=5.0,
        health_check_interval=30,
        retry=Retry(ExponentialWithJitterBackoff(cap=1.0, base=0.1), retries),
        retry_on_error=[RedisConnectionError, RedisTimeoutError],
    )


# Where Redis is.


class NoRedisError(RuntimeError):
    """The settings name no Redis."""

    reason = "REDIS_URL_MISSING"


def redis_address(settings: Settings) -> str:
    """The address to connect to. Raises NoRedisError."""
    if settings.redis_url is None:
        raise NoRedisError("set REGNF_REDIS_URL, or use `regnf serve`, which starts its own Redis")
    if settings.redis_password is None:
        return settings.redis_url
    return _with_password(settings.redis_url, settings.redis_password)


def _with_password(url: str, password: str) -> str:
    parts = urlsplit(url)
    user, _, host = parts.netloc.rpartition("@")
    name = user.partition(":")[0]
    return urlunsplit(parts._replace(netloc=f"{name}:{quote(password, safe='')}@{host}"))

"""Whether the worker of this container is alive: Redis knows one of this host that has reported lately.

A worker's registration in Redis expires unless the worker renews it, so a process that hangs, has lost Redis or was
stopped is told from one that works or waits. Exit status 0 when alive, 1 with a word on stderr when not.
"""

from __future__ import annotations

import socket
import sys

from redis import Redis, RedisError

from regnf_core.errors import InvalidInputError
from regnf_state.redis.client import NoRedisError, redis_address
from regnf_state.redis.queue import JobQueue
from regnf_state.settings import read_settings

_TIMEOUT_S = 5.0


def is_alive(redis: Redis, hostname: str) -> bool:
    """True when a worker of this host is registered for the queue, has not expired and has not said goodbye."""
    return hostname in JobQueue(redis).live_hosts()


def main() -> int:
    try:
        url = redis_address(read_settings())
    except (InvalidInputError, NoRedisError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    try:
        with Redis.from_url(url, socket_timeout=_TIMEOUT_S, socket_connect_timeout=_TIMEOUT_S) as redis:
            if is_alive(redis, socket.gethostname()):
                return 0
    except RedisError as error:
        sys.stderr.write(f"Redis does not answer: {error}\n")
        return 1
    sys.stderr.write("no worker of this host has reported lately\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())

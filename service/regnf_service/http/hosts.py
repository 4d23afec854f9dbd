"""Under which names this service answers: what a `Host` header may say.

A page whose name is made to lead here (DNS rebinding) has its own name in `Host`. So a name counts only if it was
listed, or is `localhost`. An address counts if it is of loopback, or if the connection arrived on it: no page can make
such an address its own. Without the web framework: `regnf serve` checks the lists before it loads anything else.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from regnf_state.settings import Settings, address_of

_NAME = r"[a-z0-9_](?:[a-z0-9_-]{0,62})(?:\.[a-z0-9_](?:[a-z0-9_-]{0,62}))*"
_AUTHORITY = re.compile(rf"(?P<host>{_NAME}|\[[0-9a-f:.]{{2,45}}\])(?::(?P<port>[0-9]{{1,5}}))?")
_ORIGIN = re.compile(r"(?P<scheme>https?)://(?P<authority>[^/?#@\s]+)")
_DEFAULT_PORTS = {"http": 80, "https": 443}
_LARGEST_PORT = 65535
_LONGEST = 259
ANY = "*"


class HostsError(ValueError):
    """An entry of the list names no host."""

    reason = "ALLOWED_HOSTS_UNUSABLE"


@dataclass(frozen=True)
class Authority:
    """host: a name in lower case, or an address as ``ipaddress`` writes it · port: None where none is given."""

    host: str
    port: int | None


def parse_authority(text: str) -> Authority | None:
    """What a `Host` header says; None for whatever is not exactly a host with or without a port."""
    match = _AUTHORITY.fullmatch(text.lower()) if len(text) <= _LONGEST and text.isascii() else None
    if match is None:
        return None
    host, port = match["host"], None if match["port"] is None else int(match["port"])
    address = address_of(host.strip("[]"))
    if (port is not None and not 0 < port <= _LARGEST_PORT) or (
        host.startswith("[") and (address is None or ":" not in host)
    ):
        return None
    return Authority(host if address is None else str(address), port)


def parse_origin(text: str) -> Authority | None:
    """The host and port of an `Origin`, a scheme's default port left out; None for `null` and all that is no site."""
    match = _ORIGIN.fullmatch(text.lower())
    site = parse_authority(match["authority"]) if match is not None else None
    if match is None or site is None:
        return None
    return Authority(site.host, None) if site.port == _DEFAULT_PORTS[match["scheme"]] else site


class AllowedHosts:
    """The names of this service: ``host``, ``host:port``, ``*.domain``, or ``*`` for any.

    Raises HostsError for an entry that is none of these.
    """

    def __init__(self, entries: Iterable[str]) -> None:
        listed = {entry.strip().lower() for entry in entries}
        self._any = ANY in listed
        self._exact: set[Authority] = set()
        self._domains: set[tuple[str, int | None]] = set()
        for entry in listed - {ANY}:
            found = parse_authority(entry.removeprefix("*."))
            if found is None:
                raise HostsError("REGNF_ALLOWED_HOSTS: an entry has no host; write `name`, `name:port` or `*.domain`")
            if entry.startswith("*."):
                self._domains.add((f".{found.host}", found.port))
            else:
                self._exact.add(found)

    def knows(self, host: Authority, arrived_on: str) -> bool:
        """Whether a request for ``host`` is meant for this service. ``arrived_on``: the connection's local address."""
        address = address_of(host.host)
        if self._any or host.host == "localhost" or (address is not None and address.is_loopback):
            return True
        if address is not None and address == address_of(arrived_on):
            return True
        return self._lists(host)

    def _lists(self, host: Authority) -> bool:
        ports = (host.port, None)
        return any(Authority(host.host, port) in self._exact for port in ports) or any(
            host.host.endswith(domain) and port in ports for domain, port in self._domains
        )


def is_same_site(origin: Authority, host: Authority) -> bool:
    """Whether a page of ``origin`` is a page of the service that answers as ``host``.

    The scheme does not count: behind a proxy that ends TLS the service does not see it.
    """
    return origin in (host, Authority(host.host, None) if host.port in _DEFAULT_PORTS.values() else host)


def allowed_hosts(settings: Settings) -> AllowedHosts:
    """Those that the settings list, and the host to listen on or to publish on where that is a name or one address."""
    published = (settings.publish or "").rpartition(":")[0]
    named = {_bracketed(host) for host in (settings.host, published) if host and not _is_everywhere(host)}
    return AllowedHosts({*settings.allowed_hosts, *filter(parse_authority, named)})


def _is_everywhere(host: str) -> bool:
    address = address_of(host.strip("[]"))
    return address is not None and address.is_unspecified


def _bracketed(host: str) -> str:
    bare = host.strip("[]").partition("%")[0]
    return f"[{bare}]" if ":" in bare else bare


# Sites whose pages may call the service.

_PLAIN = re.compile(r"https?://[^/?#@\s*]+")


def cors_origins(settings: Settings) -> frozenset[str]:
    """The origins that the settings list, as browsers write them. Raises HostsError for an entry that is none."""
    for entry in settings.cors_origins:
        if not _PLAIN.fullmatch(entry) or parse_origin(entry) is None or entry != entry.lower():
            raise HostsError(
                "REGNF_CORS_ORIGINS: an entry is not an origin; write `https://name` or `https://name:port`"
            )
    return settings.cors_origins

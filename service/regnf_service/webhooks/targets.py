"""Where messages may go: hosts on an allow-list, and of these only addresses that belong to the public Internet.

A name that resolves to a private address is not followed there, unless the list names that very address: whoever can
register a name must not reach what only this service can reach.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import ipaddress
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from regnf_service.problem import Problem
from regnf_service.tokens import TokensError
from regnf_state.ownership import ANONYMOUS, CALLER_NAME
from regnf_state.settings import address_of

if TYPE_CHECKING:
    from regnf_state.records import JobRecord
    from regnf_state.redis.webhook_outbox import Delivery, RedisOutbox

_PORTS = {"http": 80, "https": 443}
_MAX_URL_CHARS = 2000
_UNICAST = ipaddress.ip_network("2000::/3")
"""All of IPv6 that is given out to the Internet: what lies beyond is local, translated, or not in use."""
_SPECIAL_NAMES = (
    "192.0.0.0/24 192.31.196.0/24 192.52.193.0/24 192.88.99.0/24 192.175.48.0/24 "
    "2001::/23 2001:db8::/32 2002::/16 2620:4f:8000::/48 3fff::/20"
)
_SPECIAL = tuple(map(ipaddress.ip_network, _SPECIAL_NAMES.split()))
"""Within the rest, by IANA's registries of special-purpose addresses: protocols' own (Teredo among them), anycast of
AS112, AMT and relays of 6to4, addresses that carry IPv4 ones, examples. Python counts some of them as global."""


class Target(NamedTuple):
    """What must be equal for a URL to be allowed."""

    scheme: str
    host: str
    port: int


class AllowList:
    """Entries are ``host``, ``host:port``, or with ``http://`` in front where there is no TLS."""

    def __init__(self, entries: Iterable[str]) -> None:
        """Raises TokensError for an entry that is none."""
        self._targets = frozenset(map(_entry, entries))
        self._addresses = frozenset(target.host for target in self._targets)

    def __bool__(self) -> bool:
        return bool(self._targets)

    def allows(self, url: str) -> bool:
        """Whether messages may go to this URL, as far as the URL itself tells."""
        target = target_of(url)
        return target is not None and target in self._targets

    def permits(self, address: str) -> bool:
        """Whether a connection to this address, which a host's name resolved to, may be opened."""
        return str(address_of(address)) in self._addresses or is_public(address)


def _entry(entry: str) -> Target:
    url = entry if "://" in entry else f"https://{entry}"
    target = target_of(url)
    if target is None or urlsplit(url).path:
        raise TokensError(f"{entry[:80]!r} is not a host for webhooks: host, host:port or http://host:port")
    return target


def target_of(url: str) -> Target | None:
    """Scheme, host and port of a URL that a message can be sent to; None for any other."""
    if len(url) > _MAX_URL_CHARS or not url.isascii() or not url.isprintable() or " " in url or "\\" in url:
        return None
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme not in _PORTS or not parts.hostname or "@" in parts.netloc or parts.fragment:
        return None
    host = parts.hostname.rstrip(".")
    host = str(address_of(host) or host)
    return Target(parts.scheme, host, _PORTS[parts.scheme] if port is None else port)


def is_public(address: str) -> bool:
    """Whether an address belongs to the public Internet, those that carry another address inside aside."""
    found = address_of(address)
    if found is None or any(found in network for network in _SPECIAL) or (found.version == 6 and found not in _UNICAST):
        return False
    return found.is_global and not found.is_multicast and not found.is_reserved


# Signatures as the Standard Webhooks specification 1.0 has them: HMAC-SHA256 over id, time and body.

_PREFIX = "whsec_"
_MIN_KEY_BYTES, _MAX_KEY_BYTES = 24, 64

Secrets = Mapping[str, Sequence[bytes]]
"""Each caller's keys. With several keys each message has a signature of each, while one key replaces another."""


def read_secrets(entries: Iterable[str]) -> Secrets:
    """The keys in entries ``caller:whsec_<base64>``. Raises TokensError."""
    secrets: dict[str, list[bytes]] = {}
    for entry in entries:
        caller, _, text = entry.partition(":")
        if not CALLER_NAME.fullmatch(caller):
            raise TokensError(
                f"an entry of a webhook secret does not begin with the name of a caller; without tokens "
                f"write {ANONYMOUS}"
            )
        secrets.setdefault(caller, []).append(_key(caller, text))
    return secrets


def _key(caller: str, text: str) -> bytes:
    try:
        key = base64.b64decode(text.removeprefix(_PREFIX), validate=True) if text.startswith(_PREFIX) else b""
    except binascii.Error:
        key = b""
    if not _MIN_KEY_BYTES <= len(key) <= _MAX_KEY_BYTES:
        raise TokensError(f"the webhook secret of {caller} is not whsec_ followed by the base64 of 24 to 64 bytes")
    return key


def signed_headers(keys: Sequence[bytes], message_id: str, timestamp: int, body: bytes) -> dict[str, str]:
    """The three headers of a message; ``timestamp`` in seconds since the epoch, the id without a full stop."""
    content = f"{message_id}.{timestamp}.".encode() + body
    signatures = (base64.b64encode(hmac.digest(key, content, hashlib.sha256)).decode() for key in keys)
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(timestamp),
        "webhook-signature": " ".join(f"v1,{signature}" for signature in signatures),
    }


# What the service knows of webhooks when a request names one: who may, to where, and how its message fares.

_POINTER = "/webhook/url"


@dataclass(frozen=True)
class Webhooks:
    """The hosts that are allowed, the callers' keys, and the outbox."""

    allowed: AllowList
    secrets: Secrets
    outbox: RedisOutbox

    def check(self, caller: str, url: str | None) -> None:
        """Whether this caller may name this address. Raises Problem WEBHOOK_NOT_ALLOWED."""
        if url is None:
            return
        if not self.allowed.allows(url):
            raise Problem("WEBHOOK_NOT_ALLOWED", errors=[{"pointer": _POINTER, "detail": "the host is not allowed"}])
        if caller not in self.secrets:
            fault = {"pointer": _POINTER, "detail": "the service has no secret to sign your messages"}
            raise Problem("WEBHOOK_NOT_ALLOWED", errors=[fault])

    def deliveries(self, record: JobRecord) -> list[Delivery]:
        """The state of the message to each of the job's webhooks."""
        return self.outbox.deliveries(record)

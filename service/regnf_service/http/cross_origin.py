"""Pages of other sites that the operator has named may call the service (CORS). Without a list none may."""

from __future__ import annotations

import re

from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware

from regnf_service.http.hosts import HostsError, parse_origin
from regnf_state.settings import Settings

_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
_ASKED = (
    "Authorization", "Content-Type", "Content-Digest", "Content-Range", "Idempotency-Key", "If-None-Match",
    "Last-Event-ID", "Prefer", "Range", "X-Request-ID",
)  # fmt: skip
_TOLD = ("Content-Range", "ETag", "Location", "Retry-After", "WWW-Authenticate", "X-Request-ID")
_PLAIN = re.compile(r"https?://[^/?#@\s*]+")


def cors_origins(settings: Settings) -> frozenset[str]:
    """The origins that the settings list, as browsers write them. Raises HostsError for an entry that is none."""
    for entry in settings.cors_origins:
        if not _PLAIN.fullmatch(entry) or parse_origin(entry) is None or entry != entry.lower():
            raise HostsError("REGNF_CORS_ORIGINS: an entry is no origin; write `https://name` or `https://name:port`")
    return settings.cors_origins


def cors_layer(origins: frozenset[str]) -> list[Middleware]:
    """Answers what browsers ask before a call, and lets those pages read the answers. No cookies are involved."""
    if not origins:
        return []
    return [
        Middleware(
            CORSMiddleware,
            allow_origins=sorted(origins),
            allow_methods=_METHODS,
            allow_headers=_ASKED,
            expose_headers=_TOLD,
        )
    ]

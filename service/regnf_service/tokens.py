"""Which token is whose. Entries are ``name:token``, or a token alone, whose caller is named after its digest."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterable, Mapping

from regnf_state.ownership import ANONYMOUS, CALLER_NAME

Callers = Mapping[bytes, str]
"""The names of callers by the SHA-256 of their tokens. A caller may have several tokens, while one replaces another."""


class TokensError(ValueError):
    """The tokens cannot be told apart. The text names no token."""

    reason = "TOKENS_UNUSABLE"


def read_callers(entries: Iterable[str]) -> Callers:
    """The callers of all entries. Raises TokensError."""
    callers: dict[bytes, str] = {}
    for entry in entries:
        name, token = split_entry(entry)
        digest = _digest(token)
        name = name or f"token-{digest.hex()[:8]}"
        if callers.setdefault(digest, name) != name:
            raise TokensError(f"the callers {callers[digest]} and {name} have the same token")
    return callers


def split_entry(entry: str) -> tuple[str | None, str]:
    """(caller's name, secret). Raises TokensError for a secret that is no printable word, and for a reserved name."""
    name, colon, secret = entry.partition(":")
    named = bool(colon) and CALLER_NAME.fullmatch(name) is not None
    if not named:
        name, secret = "", entry
    if not secret or not secret.isascii() or not secret.isprintable() or " " in secret:
        raise TokensError(f"the entry of {name or 'a caller without a name'} has no token")
    if name == ANONYMOUS:
        raise TokensError(f"the name {ANONYMOUS} is reserved for callers without a token")
    return name or None, secret


def caller_of(callers: Callers, authorization: str) -> str | None:
    """The caller whose token is in an Authorization header. Takes as long for a wrong token as for a right one."""
    scheme, _, token = authorization.partition(" ")
    # all digests have the same length, so a comparison reveals nothing about the length of a token
    digest = _digest(token.strip())
    found = [name for known, name in callers.items() if hmac.compare_digest(digest, known)]
    return found[0] if found and scheme.lower() == "bearer" else None


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()

"""Signatures as the Standard Webhooks specification 1.0 has them: HMAC-SHA256 over id, time and body."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from regnf_service.tokens import TokensError, read_lines
from regnf_state.ownership import ANONYMOUS, CALLER_NAME

_PREFIX = "whsec_"
_MIN_KEY_BYTES, _MAX_KEY_BYTES = 24, 64

Secrets = Mapping[str, Sequence[bytes]]
"""Each caller's keys. With several keys each message has a signature of each, while one key replaces another."""


def read_secrets(entries: Iterable[str], file: Path | None) -> Secrets:
    """The keys in entries ``caller:whsec_<base64>``, those of the file included. Raises TokensError."""
    secrets: dict[str, list[bytes]] = {}
    for entry in (*entries, *(read_lines(file) if file is not None else ())):
        caller, _, text = entry.partition(":")
        if not CALLER_NAME.fullmatch(caller):
            raise TokensError(f"an entry of a webhook secret begins with no caller's name; without tokens: {ANONYMOUS}")
        secrets.setdefault(caller, []).append(_key(caller, text))
    return secrets


def _key(caller: str, text: str) -> bytes:
    try:
        key = base64.b64decode(text.removeprefix(_PREFIX), validate=True) if text.startswith(_PREFIX) else b""
    except binascii.Error:
        key = b""
    if not _MIN_KEY_BYTES <= len(key) <= _MAX_KEY_BYTES:
        raise TokensError(f"the webhook secret of {caller} is not whsec_ and the base64 of 24 to 64 bytes")
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

"""The digests that clients announce: in a path, and in Content-Digest (RFC 9530)."""

from __future__ import annotations

import base64
import binascii
import re

from regnf_service.problem import CLOSE, Problem

_SHA256 = re.compile(r"[0-9a-f]{64}")
_MEMBER = re.compile(r"\s*([a-z0-9*_.-]{1,32})=:([A-Za-z0-9+/=]{0,128}):\s*")


def is_sha256(text: str) -> bool:
    """Whether the text is a SHA-256 as fields are named: 64 lower-case hexadecimal digits."""
    return _SHA256.fullmatch(text) is not None


def announced_digest(header: str | None) -> str | None:
    """The sha-256 of a Content-Digest header in hexadecimal; None when there is none to compare with.

    Raises Problem INVALID_DIGEST.
    """
    if header is None:
        return None
    for member in header.split(","):
        match = _MEMBER.fullmatch(member)
        if match is None:
            raise Problem("INVALID_DIGEST", "Content-Digest is not sha-256=:base64:.", headers=CLOSE)
        if match.group(1) == "sha-256":
            return _decoded(match.group(2))
    return None


def _decoded(text: str) -> str:
    try:
        value = base64.b64decode(text, validate=True)
    except binascii.Error:
        value = b""
    if len(value) != 32:
        raise Problem("INVALID_DIGEST", "Content-Digest holds no SHA-256.", headers=CLOSE)
    return value.hex()

"""Page tokens: where the page before ended. They carry no secret and open nothing, so they need no signature."""

from __future__ import annotations

import base64
import binascii
import json
import math

from regnf_service.problem import Problem


def encode_token(created: float, name: str) -> str:
    """The token for what is older than this record."""
    return base64.urlsafe_b64encode(json.dumps([created, name]).encode()).decode().rstrip("=")


def decode_token(token: str | None) -> tuple[float, str] | None:
    """(created, name) from a token. Raises Problem INVALID_PAGE_TOKEN."""
    if token is None:
        return None
    try:
        value = json.loads(base64.b64decode(token + "=" * (-len(token) % 4), altchars=b"-_", validate=True))
    except (ValueError, binascii.Error, RecursionError) as error:
        raise Problem("INVALID_PAGE_TOKEN") from error
    match value:
        case [float() | int() as created, str() as name] if math.isfinite(created) and name.isascii():
            return float(created), name
    raise Problem("INVALID_PAGE_TOKEN")

"""Page tokens: where the look for the page before ended. They carry no secret and open nothing, so none is signed."""

from __future__ import annotations

import base64
import binascii
import json
import math

from regnf_service.problem import Problem
from regnf_state.pages import Position

NEXT_PAGE = "For the next page's `page_token`; null on the last page. A page before the last may be short or empty."


def encode_token(rest: Position | None) -> str | None:
    """The token for what is older than this position; None when there is no more."""
    if rest is None:
        return None
    return base64.urlsafe_b64encode(json.dumps(rest).encode()).decode().rstrip("=")


def decode_token(token: str | None) -> Position | None:
    """The position from a token. Raises Problem INVALID_PAGE_TOKEN."""
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

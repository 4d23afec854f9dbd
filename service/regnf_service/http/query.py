"""Query parameters that an address does not know are refused: a misspelt `dry_run` would start a job."""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections import Counter

from fastapi.routing import APIRoute
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import Scope

from regnf_service.problem import Problem, json_pointer
from regnf_state.record_store import Position

_MOST_PARAMETERS = 32


async def refuse_unknown_parameters(request: Request) -> None:
    """Raises Problem INVALID_QUERY for parameters that the route does not take, or takes once and was given twice."""
    if request.scope["query_string"].count(b"&") >= _MOST_PARAMETERS:
        raise Problem("INVALID_QUERY", f"At most {_MOST_PARAMETERS} parameters are allowed.")
    route = request.scope["route"]
    if not request.query_params or not isinstance(route, APIRoute):
        return
    known = {field.alias for field in route.dependant.query_params}
    given = Counter(name for name, _ in request.query_params.multi_items())
    errors = [
        # a name that is odd or long is not repeated
        {"parameter": name if json_pointer([name]) else "", "detail": "given twice" if name in known else "unknown"}
        for name, count in given.items()
        if name not in known or count > 1
    ]
    if errors:
        raise Problem("INVALID_QUERY", errors=errors)


# Page tokens: where the look for the page before ended. They carry no secret and open nothing, so none is signed.

_FORGED = "Give the unchanged `next_page_token` of the previous page as `page_token`."
NEXT_PAGE = "The `page_token` of the next page; null on the last page. Other pages may be short or empty as well."


def encode_token(rest: Position | None) -> str | None:
    """The token for what is older than this position; None when there is no more."""
    if rest is None:
        return None
    return base64.urlsafe_b64encode(json.dumps(rest).encode()).decode().rstrip("=")


def decode_token(token: str | None) -> Position | None:
    """The position from a token. Raises Problem INVALID_QUERY."""
    if token is None:
        return None
    try:
        value = json.loads(base64.b64decode(token + "=" * (-len(token) % 4), altchars=b"-_", validate=True))
    except (ValueError, binascii.Error, RecursionError) as error:
        raise Problem("INVALID_QUERY", _FORGED) from error
    match value:
        case [float() | int() as created, str() as name] if math.isfinite(created) and name.isascii():
            return float(created), name
    raise Problem("INVALID_QUERY", _FORGED)


# Which requests a page answers and which JSON: addresses that people open in a browser have both.

_HOME = re.compile(r"(/v1)?(/|/jobs|/fields|/library)")


def wants_page(scope: Scope) -> bool:
    """Whether the sender would rather have a page than JSON: a browser that opens the address names HTML first."""
    first = Headers(scope=scope).get("accept", "").split(",")[0].partition(";")[0]
    return scope["method"] in ("GET", "HEAD") and first.strip().lower() == "text/html"


def is_home_page(scope: Scope) -> bool:
    """Whether a browser opens one of the addresses of the home page, which holds no data and needs no token."""
    return _HOME.fullmatch(scope["path"]) is not None and wants_page(scope)

"""Query parameters that an address does not know are refused: a misspelt `dry_run` would start a job."""

from __future__ import annotations

from collections import Counter

from fastapi.routing import APIRoute
from starlette.requests import Request

from regnf_service.problem import CLOSE, Problem, json_pointer

_MOST_PARAMETERS = 32


async def refuse_unknown_parameters(request: Request) -> None:
    """Raises Problem INVALID_QUERY for parameters that the route does not take, or takes once and was given twice."""
    if request.scope["query_string"].count(b"&") >= _MOST_PARAMETERS:
        raise Problem("INVALID_QUERY", f"At most {_MOST_PARAMETERS} parameters are taken.", headers=CLOSE)
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
        raise Problem(
            "INVALID_QUERY", errors=errors, headers=CLOSE if request.method in ("POST", "PUT", "PATCH") else None
        )

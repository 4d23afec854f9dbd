"""What routes are given: the services, and the small readings of a request that several of them share.

All are coroutines: the framework would run a plain function in a thread, which costs more than most answers.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query
from starlette.requests import Request

from regnf_service.services import Services


async def services_of(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


async def prefix_of(request: Request) -> str:
    """What the caller's paths begin with: "" or "/v1", behind whatever a proxy put in front."""
    root = str(request.scope.get("root_path", ""))
    path = request.scope["path"].removeprefix(root)
    return root + ("/v1" if path == "/v1" or path.startswith("/v1/") else "")


async def caller_of_request(request: Request) -> str:
    """Whose call it is."""
    caller: str = request.state.caller
    return caller


ServicesDep = Annotated[Services, Depends(services_of)]
CallerDep = Annotated[str, Depends(caller_of_request)]
PrefixDep = Annotated[str, Depends(prefix_of)]
WaitQuery = Annotated[int, Query(ge=0, le=30, description="Seconds to hold the answer back for news.")]
LimitQuery = Annotated[int, Query(ge=1, le=200, description="How many to return at most.")]
PageTokenQuery = Annotated[str | None, Query(max_length=200, description="`next_page_token` of the page before.")]

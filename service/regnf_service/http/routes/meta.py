"""State, version and contract of the service."""

from __future__ import annotations

import asyncio
import logging
import platform
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Query
from redis.exceptions import RedisError
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response

from regnf_core import __version__
from regnf_service.concurrency import PROBES, blocking, in_thread
from regnf_service.http.body import PrefixDep, ServicesDep
from regnf_service.http.contract import contract_json, contract_yaml
from regnf_service.http.problems import problem_of
from regnf_service.http.query import wants_page
from regnf_service.http.routes.documentation import get_and_head, refusals
from regnf_service.http.routes.pages import HTML, page
from regnf_service.http.schemas.results import HealthDocument, IndexDocument, ReadyDocument, VersionDocument
from regnf_service.problem import RETRY_LATER, Problem
from regnf_service.services import Services
from regnf_state.records import RecordError, RecordsFullError

router = APIRouter(tags=["service"])
logger = logging.getLogger(__name__)
WorkerQuery = Annotated[bool, Query(description="Whether a live worker is required.")]


@get_and_head(router, "/healthz", summary="Liveness: the process responds", response_model=HealthDocument)
async def healthz() -> dict[str, str]:
    """Needs no token. Nothing else is checked."""
    return {"status": "ok"}


@get_and_head(
    router,
    "/readyz",
    summary="Readiness: a registration can run",
    response_model=ReadyDocument,
    responses=refusals("INVALID_QUERY", "NOT_READY"),
)
async def readyz(services: ServicesDep, worker: WorkerQuery = True) -> dict[str, object]:
    """Checks that the job store and the storage accept a write, and that at least one worker is alive.

    A 503 has the same `checks`. Its `detail` names what is missing, and its `reasons` give the causes. With
    `worker=false` no worker is required: uploads and requests are then accepted and wait for a worker.
    """
    return await PROBES.run(_readiness, services, worker)


def _readiness(services: Services, worker: bool) -> dict[str, object]:
    faults = {
        "records": _fault(lambda: _records_write(services)),
        "storage": _fault(services.blobs.probe),
        "worker": _fault(lambda: services.queue.live_workers() > 0),
    }
    checks = {name: reason is None for name, reason in faults.items()}
    missing = {name: reason for name, reason in faults.items() if reason and (worker or name != "worker")}
    if missing:
        told = ", ".join(f"{name} ({reason})" for name, reason in missing.items())
        extra = {"checks": checks, "reasons": missing}
        raise Problem("NOT_READY", f"Missing: {told}.", headers=RETRY_LATER, extra=extra)
    return {"status": "ready", "checks": checks}


def _fault(check: Callable[[], object]) -> str | None:
    try:
        return "NO_WORKER" if check() is False else None
    except (RedisError, OSError, RecordError) as error:
        logger.warning("not ready: %s", type(error).__name__)
        return problem_of(error).reason


def _records_write(services: Services) -> None:
    services.records.probe()
    if services.room.is_full:
        raise RecordsFullError("Redis has less free memory than its reserve")


@get_and_head(router, "/version", summary="Version of the service", response_model=VersionDocument)
async def version() -> dict[str, str]:
    return {"name": "regnf", "version": __version__, "python": platform.python_version()}


@get_and_head(router, "/", summary="All addresses", response_model=IndexDocument, responses={200: {"content": HTML}})
async def index(request: Request, prefix: PrefixDep) -> Response:
    """The entry point of the API. A browser gets the home page, which needs no token."""
    if wants_page(request.scope):
        return page("home.html")
    paths = request.app.openapi()["paths"]
    addresses = {
        f"{method.upper()} {prefix}{path}": operation["summary"]
        for path, operations in paths.items()
        for method, operation in operations.items()
    }
    document = {"name": "regnf", "version": __version__, "addresses": addresses}
    return JSONResponse(document, headers={"Vary": "Accept"})


@get_and_head(
    router,
    "/openapi.yaml",
    summary="This contract",
    response_class=Response,
    responses={200: {"content": {"application/yaml": {"schema": {"type": "object"}}}}},
)
async def openapi_yaml(request: Request) -> Response:
    return Response(await _made_once(request, contract_yaml, request.app), media_type="application/yaml")


@get_and_head(
    router,
    "/openapi.json",
    summary="This contract as JSON",
    response_class=Response,
    responses={200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
)
async def openapi_json(request: Request) -> Response:
    return Response(await _made_once(request, contract_json, request.app), media_type="application/json")


@get_and_head(
    router,
    "/docs",
    summary="This contract as a web page",
    response_class=FileResponse,
    responses={200: {"description": "The page.", "content": HTML}},
)
@blocking
def docs() -> FileResponse:
    """All addresses, each with a form to try it, all reasons and all schemas.

    The page reads the contract and asks for a token if one is needed. It loads nothing from other hosts.
    """
    return page("docs.html")


async def _made_once(request: Request, make: Callable[[Any], str], source: Any) -> bytes:
    """What ``make`` writes, kept with the application: made for the first request, in a thread, for it takes as long as
    a hundred polls; all answers share it."""
    made: dict[str, asyncio.Future[bytes]] = request.app.state.__dict__.setdefault("made_once", {})
    if make.__name__ not in made:
        made[make.__name__] = asyncio.ensure_future(in_thread(lambda: make(source).encode()))
    return await asyncio.shield(made[make.__name__])

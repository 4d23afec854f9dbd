"""What the service says about itself."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable
from typing import Annotated

from fastapi import APIRouter, Query
from redis.exceptions import RedisError
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from regnf_core import __version__
from regnf_service.concurrency import blocking
from regnf_service.http.contract import contract_yaml
from regnf_service.http.dependencies import PrefixDep, ServicesDep
from regnf_service.http.docs_page import STYLE_POLICY, render_docs
from regnf_service.http.routes.documentation import get_and_head, refusals
from regnf_service.http.schemas.meta import HealthDocument, IndexDocument, ReadyDocument, VersionDocument
from regnf_service.problem import RETRY_LATER, Problem
from regnf_service.services import Services

router = APIRouter(tags=["service"])
logger = logging.getLogger(__name__)
WorkerQuery = Annotated[bool, Query(description="Whether a live worker is asked for too.")]


@get_and_head(router, "/healthz", summary="Whether the process answers", response_model=HealthDocument)
async def healthz() -> dict[str, str]:
    """Needs no token, looks at nothing else."""
    return {"status": "ok"}


@get_and_head(
    router,
    "/readyz",
    summary="Whether a registration would run",
    response_model=ReadyDocument,
    responses=refusals("INVALID_QUERY", "NOT_READY"),
)
@blocking
def readyz(services: ServicesDep, worker: WorkerQuery = True) -> dict[str, object]:
    """Records, storage and at least one live worker. A 503 has the same `checks`, and its detail names what is missing.

    With `worker=false` no worker is asked for: whether uploads and requests would be taken, to wait for one.
    """
    checks = {
        "records": _answers(services.records.ping),
        "storage": _answers(lambda: _storage_writes(services)),
        "worker": _answers(lambda: services.queue.live_workers() > 0),
    }
    missing = [name for name, there in checks.items() if not there and (worker or name != "worker")]
    if missing:
        raise Problem("NOT_READY", f"Missing: {', '.join(missing)}.", headers=RETRY_LATER, extra={"checks": checks})
    return {"status": "ready", "checks": checks}


def _answers(check: Callable[[], bool]) -> bool:
    try:
        return check()
    except (RedisError, OSError) as error:
        logger.warning("not ready: %s", type(error).__name__)
        return False


def _storage_writes(services: Services) -> bool:
    services.blobs.probe()
    return True


@get_and_head(router, "/version", summary="What runs here", response_model=VersionDocument)
async def version() -> dict[str, str]:
    return {"name": "regnf", "version": __version__, "python": platform.python_version()}


@get_and_head(router, "/", summary="Every address", response_model=IndexDocument)
async def index(request: Request, prefix: PrefixDep) -> dict[str, object]:
    """Start here."""
    paths = request.app.openapi()["paths"]
    addresses = {
        f"{method.upper()} {prefix}{path}": operation["summary"]
        for path, operations in paths.items()
        for method, operation in operations.items()
    }
    return {"name": "regnf", "version": __version__, "addresses": addresses}


@get_and_head(
    router,
    "/openapi.yaml",
    summary="This contract",
    response_class=Response,
    responses={200: {"content": {"application/yaml": {"schema": {"type": "object"}}}}},
)
async def openapi_yaml(request: Request) -> Response:
    return Response(contract_yaml(request.app), media_type="application/yaml")


@get_and_head(router, "/docs", summary="This contract, for people", response_class=HTMLResponse)
async def docs(request: Request) -> HTMLResponse:
    """One page without scripts; loads nothing from elsewhere."""
    return HTMLResponse(render_docs(request.app.openapi()), headers={"Content-Security-Policy": STYLE_POLICY})

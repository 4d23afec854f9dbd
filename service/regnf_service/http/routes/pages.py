"""The pages. They read everything through the API, so they hold no data themselves and need no token."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from starlette.responses import FileResponse

from regnf_service.concurrency import blocking
from regnf_service.http.body import ServicesDep
from regnf_service.http.routes.documentation import get_and_head, refusals
from regnf_service.jobs.edits import find_job
from regnf_state.ownership import ANONYMOUS

router = APIRouter(tags=["results"])
WEB = Path(__file__).resolve().parents[2] / "web"
HTML = {"text/html": {"schema": {"type": "string"}}}
"""Of an address that a browser gets a page from."""
PAGE_POLICY = "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"


@get_and_head(
    router,
    "/jobs/{id}/view",
    summary="A job's page, with the registration in 3D",
    response_class=FileResponse,
    responses={
        200: {"description": "The page.", "content": HTML},
        **refusals("JOB_NOT_FOUND", "JOB_EXPIRED"),
    },
)
@blocking
def view(id: str, services: ServicesDep) -> FileResponse:  # noqa: A002
    """The page shows the progress of an active job. If the service needs a token, the page asks for it."""
    if not services.settings.needs_token:
        # with tokens the page comes before the token, so it must not tell which jobs there are
        find_job(services, id, ANONYMOUS)
    return page("view.html")


def page(name: str) -> FileResponse:
    """One of the pages. At an address that has JSON too, the two must not be taken for each other."""
    headers = {"Content-Security-Policy": PAGE_POLICY, "Cache-Control": "no-cache", "Vary": "Accept"}
    return FileResponse(WEB / name, media_type="text/html", headers=headers)

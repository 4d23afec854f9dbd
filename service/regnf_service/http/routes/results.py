"""A job's result and artifacts."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from regnf_core.document import ResultDocument
from regnf_service.concurrency import DRAWING, blocking
from regnf_service.http.body import CallerDep, PrefixDep, ServicesDep, wait_for
from regnf_service.http.ranges import IfNoneMatchDep, IfRangeHeader, RangeHeader, file_answer, parse_range
from regnf_service.http.routes.documentation import BINARY, JSON, NOT_MODIFIED, header, links, refusals
from regnf_service.http.schemas.scenes import RenderResultDocument
from regnf_service.jobs.drawing import drawn
from regnf_service.jobs.edits import find_job, manifest_of, result_of
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.manifest import MEDIA_TYPES, Manifest

router = APIRouter(tags=["results"])
_CACHE = "private, max-age=0, must-revalidate"
_ARTIFACT_WAIT_S = 20
ArtifactWaitQuery = Annotated[
    int, Query(ge=0, le=30, description="Longest time to wait for a file that is still being made, seconds.")
]
_FILES = {kind: {} if kind == JSON else BINARY for kind in sorted(MEDIA_TYPES)}


def _manifest(services: Services, job_id: str, caller: str) -> Manifest:
    return manifest_of(services, find_job(services, job_id, caller))


@router.get(
    "/jobs/{id}/result",
    summary="The result of a registration or a rendering",
    response_model=ResultDocument | RenderResultDocument,
    responses={
        200: {"links": links("name", "/artifacts/0/name", "get_artifact", "head_artifact", id="id")},
        **refusals("JOB_NOT_FOUND JOB_NOT_READY JOB_DISMISSED JOB_FAILED JOB_EXPIRED"),
    },
)
@blocking
def get_result(id: str, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> Any:  # noqa: A002
    """A failed job has no result. The member `error` of the 409 has the reason why the job failed.

    The result is available before its point clouds and pictures, which are listed as `pending` until they are made.
    `preview.png` is drawn from the point clouds at its first request. Until then its `bytes` and `sha256` are null.
    """
    manifest = _manifest(services, id, caller)
    document = result_of(services, manifest)
    known = {one["name"]: one for one in document.get("artifacts", ())}  # a rendering says what its files show
    drawable = "pending" if manifest.pending else "ready"
    told = {
        **{
            name: {"state": "ready", "bytes": one.bytes, "sha256": one.sha256}
            for name, one in manifest.served().items()
        },
        **{name: {"state": "pending", "bytes": None, "sha256": None} for name in manifest.pending},
        **{name: {"state": drawable, "bytes": None, "sha256": None} for name in manifest.on_request},
    }
    listed = [
        known.get(name, {}) | {"name": name, "url": f"{prefix}/jobs/{id}/artifacts/{name}"} | one
        for name, one in told.items()
    ]
    added = {"artifacts": listed} | ({"missing_artifacts": list(manifest.missing)} if manifest.missing else {})
    return JSONResponse(document | added, headers={"Cache-Control": _CACHE})


_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The whole file.", "content": _FILES},
    206: {
        "description": "The requested range.",
        "content": _FILES,
        "headers": {"Content-Range": header("The position of these bytes in the file.")},
    },
    304: NOT_MODIFIED,
    **refusals(
        "JOB_NOT_FOUND ARTIFACT_NOT_FOUND ARTIFACT_NOT_READY JOB_NOT_READY JOB_DISMISSED JOB_FAILED JOB_EXPIRED "
        "RANGE_NOT_SATISFIABLE INVALID_QUERY"
    ),
}


@router.head(
    "/jobs/{id}/artifacts/{name}",
    summary="An artifact's size",
    operation_id="head_artifact",
    response_class=Response,
    responses=_RESPONSES,
)
@router.get(
    "/jobs/{id}/artifacts/{name}", summary="An artifact's bytes", response_class=StreamingResponse, responses=_RESPONSES
)
async def get_artifact(
    request: Request,
    id: str,  # noqa: A002
    name: str,
    services: ServicesDep,
    held: IfNoneMatchDep,
    range_: RangeHeader = None,
    if_range: IfRangeHeader = None,
    wait: ArtifactWaitQuery = _ARTIFACT_WAIT_S,
) -> Response:
    """The names are in the result's list `artifacts`. If the file is still being made, the response is sent when it is
    finished.

    `preview.png` is drawn from the point clouds at its first request.
    """
    caller = request.state.caller

    def is_settled(now: Manifest) -> bool:
        return not now.pending or name not in (*now.pending, *now.on_request)

    manifest = await wait_for(lambda: _manifest(services, id, caller), is_settled, wait, services, caller)
    if not is_settled(manifest):
        raise Problem("ARTIFACT_NOT_READY", headers={"Retry-After": "1"})
    if name in manifest.on_request:
        manifest = await DRAWING.run(drawn, services, manifest)
    artifact = manifest.served().get(name)
    if artifact is None:
        raise Problem("ARTIFACT_NOT_FOUND")
    size, etag = artifact.bytes, f'"{artifact.sha256[:32]}"'
    headers = {"ETag": etag, "Accept-Ranges": "bytes", "Cache-Control": _CACHE}
    headers["Content-Disposition"] = f'attachment; filename="{name}"'
    part = parse_range(range_ if if_range in (None, etag) else None, size)
    try:
        return await file_answer(request, services.blobs, manifest.key(name), artifact.media_type, headers, held, part)
    except FileNotFoundError as error:
        raise Problem("ARTIFACT_NOT_FOUND") from error

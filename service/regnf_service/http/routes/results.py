"""A job's result and artifacts."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Header
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from regnf_service.concurrency import blocking, in_thread
from regnf_service.http.dependencies import CallerDep, PrefixDep, ServicesDep
from regnf_service.http.etags import IfNoneMatchDep
from regnf_service.http.ranges import ByteRange, parse_range
from regnf_service.http.routes.documentation import BINARY, JSON, NOT_MODIFIED, header, links, refusals
from regnf_service.http.schemas.common import whole_problem
from regnf_service.http.schemas.results import ResultDocument
from regnf_service.jobs.lookup import find_job
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.manifest import ARTIFACTS, Manifest, read_manifest, read_result
from regnf_state.records import ACTIVE, JobRecord

router = APIRouter(tags=["results"])
_BLOCK_BYTES = 256 * 1024
_CACHE = "private, max-age=0, must-revalidate"
_FILES = {kind: {} if kind == JSON else BINARY for kind in sorted(set(ARTIFACTS.values()))}


def _require_successful(record: JobRecord) -> None:
    """Raises Problem JOB_NOT_READY, JOB_DISMISSED, JOB_FAILED with what ended the job.

    A failed job is 409 whatever ended it: this request met no error of the server, and polling it must raise no alarm.
    """
    if record.status in ACTIVE:
        raise Problem("JOB_NOT_READY", headers={"Retry-After": "1"})
    if record.status == "dismissed":
        raise Problem("JOB_DISMISSED")
    if record.status == "failed":
        error = whole_problem(record.error or {})
        raise Problem("JOB_FAILED", f"{error['reason']}: {error['detail']}", extra={"error": error})


def _manifest(services: Services, job_id: str, caller: str) -> Manifest:
    """The manifest of a successful job. Raises as ``find_job`` and ``_require_successful``, and Problem JOB_EXPIRED."""
    _require_successful(find_job(services, job_id, caller))
    manifest = read_manifest(services.blobs, job_id)
    if manifest is None:
        raise Problem("JOB_EXPIRED")
    return manifest


@router.get(
    "/jobs/{id}/result",
    summary="What the registration found",
    response_model=ResultDocument,
    responses={
        200: {"links": links("name", "/artifacts/0/name", "get_artifact", "head_artifact", id="id")},
        **refusals(
            "JOB_NOT_FOUND",
            "JOB_NOT_READY",
            "JOB_DISMISSED",
            "JOB_FAILED",
            "JOB_EXPIRED",
        ),
    },
)
@blocking
def get_result(id: str, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> Any:  # noqa: A002
    """A failed job has no result: the member `error` of the 409 is the job's own problem."""
    manifest = _manifest(services, id, caller)
    try:
        document = read_result(services.blobs, manifest)
    except FileNotFoundError as error:
        raise Problem("JOB_EXPIRED") from error
    listed = [
        {"name": name, "bytes": entry.bytes, "sha256": entry.sha256, "url": f"{prefix}/jobs/{id}/artifacts/{name}"}
        for name, entry in manifest.served().items()
    ]
    return JSONResponse(document | {"artifacts": listed}, headers={"Cache-Control": _CACHE})


_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The whole file.", "content": _FILES},
    206: {
        "description": "The range asked for.",
        "content": _FILES,
        "headers": {"Content-Range": header("Which bytes these are.")},
    },
    304: NOT_MODIFIED,
    **refusals(
        "JOB_NOT_FOUND",
        "ARTIFACT_NOT_FOUND",
        "JOB_NOT_READY",
        "JOB_DISMISSED",
        "JOB_FAILED",
        "JOB_EXPIRED",
        "RANGE_NOT_SATISFIABLE",
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
    caller: CallerDep,
    held: IfNoneMatchDep,
    range_: Annotated[str | None, Header(alias="Range", description="One range, `bytes=first-last`.")] = None,
    if_range: Annotated[str | None, Header(description="The ETag that the range belongs to.")] = None,
) -> Response:
    """The names are those of the result's `artifacts` list."""
    manifest = await in_thread(_manifest, services, id, caller)
    artifact = manifest.served().get(name)
    if artifact is None:
        raise Problem("ARTIFACT_NOT_FOUND")
    size, etag = artifact.bytes, f'"{artifact.sha256[:32]}"'
    headers = {"ETag": etag, "Accept-Ranges": "bytes", "Cache-Control": _CACHE}
    if held.matches(etag):
        return Response(status_code=304, headers=headers)
    part = parse_range(range_, size) if if_range in (None, etag) else None
    if part is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.start + part.length - 1}/{size}"
    chosen = part or ByteRange(0, size)
    headers |= {"Content-Length": str(chosen.length), "Content-Disposition": f'attachment; filename="{name}"'}
    status = 200 if part is None else 206
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=artifact.media_type)
    file = await in_thread(_open, services, manifest, name)
    return StreamingResponse(_blocks(file, chosen), status_code=status, headers=headers, media_type=artifact.media_type)


def _open(services: Services, manifest: Manifest, name: str) -> BinaryIO:
    try:
        return services.blobs.open(manifest.key(name))
    except FileNotFoundError as error:
        raise Problem("ARTIFACT_NOT_FOUND") from error


async def _blocks(file: BinaryIO, part: ByteRange) -> AsyncIterator[bytes]:
    """The part's bytes, a block at a time, each read in a thread."""
    left = part.length
    try:
        await in_thread(file.seek, part.start)
        while left:
            block = await in_thread(file.read, min(left, _BLOCK_BYTES))
            if not block:
                return
            left -= len(block)
            yield block
    finally:
        file.close()

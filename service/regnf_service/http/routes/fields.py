"""GET, HEAD and DELETE of fields: what is held, and in which state."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from regnf_core.errors import MOST_CANDIDATES
from regnf_core.field_notes import MESH_NAMES, PICTURE_NAME
from regnf_core.importing.upload_description import UploadDescription
from regnf_service.concurrency import blocking, in_thread
from regnf_service.fields.redescribe import missing_view, redescribe
from regnf_service.http import body
from regnf_service.http.body import (
    CallerDep,
    LimitQuery,
    PageTokenQuery,
    PrefixDep,
    ServicesDep,
    WaitQuery,
    read_json,
    wait_for,
)
from regnf_service.http.query import decode_token, encode_token, wants_page
from regnf_service.http.ranges import IfNoneMatch, IfNoneMatchDep, field_etag, file_answer, is_sha256
from regnf_service.http.routes.documentation import (
    BINARY,
    FIELD_LINKS,
    JSON,
    NOT_MODIFIED,
    get_and_head,
    header,
    refusals,
)
from regnf_service.http.routes.pages import HTML, page
from regnf_service.http.schemas.fields import FieldChange, FieldDocument, FieldPage, field_document
from regnf_service.http.schemas.reading import read_model, reference
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.ownership import reference_of
from regnf_state.pieces import view_key
from regnf_state.queue import Work
from regnf_state.records import FieldRecord
from regnf_state.room import candidate_key

router = APIRouter(tags=["fields"])
_PATCHES = (JSON, "application/merge-patch+json")
_NUMBERS = frozenset(str(number) for number in range(1, MOST_CANDIDATES + 1))
_CHANGE = {"schema": reference(FieldChange)}
_PRIVATE_HOUR = "private, max-age=3600"
FIELD_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"headers": {"ETag": header("For If-None-Match.")}},
    304: NOT_MODIFIED,
    **refusals("INVALID_QUERY", "FIELD_NOT_FOUND"),
}
_PICTURE_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "Two views of the surface and a section.", "content": {"image/png": BINARY}},
    304: NOT_MODIFIED,
    **refusals("FIELD_NOT_FOUND", "FIELD_VIEW_NOT_FOUND"),
}


def require_field(services: Services, caller: str, sha256: str) -> FieldRecord:
    """The caller's field or recording of this name. Raises Problem FIELD_NOT_FOUND."""
    record = services.records.get_field(reference_of(caller, sha256)) if is_sha256(sha256) else None
    if record is None:
        raise Problem("FIELD_NOT_FOUND")
    return record


@get_and_head(
    router,
    "/fields/{sha256}",
    summary="State of a field and report of its import",
    response_model=FieldDocument,
    responses=FIELD_ANSWERS,
)
async def get_field(
    sha256: str,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    held: IfNoneMatchDep,
    wait: WaitQuery = 0,
) -> Response:
    """With `wait`, the response is sent when the field is not `validating`. With `If-None-Match` too, it is sent at the
    first change.

    Every known field gives 200, also a rejected one. The file of a rejected field was deleted and can be uploaded
    again.
    """

    def is_news(found: FieldRecord) -> bool:
        return found.state != "validating" or held.differs(field_etag(found))

    record = await wait_for(lambda: require_field(services, caller, sha256), is_news, wait, services, caller)
    headers = {"ETag": field_etag(record), "Cache-Control": "no-cache"}
    position = None
    if record.state == "validating":
        headers["Retry-After"] = "1"
        work = Work("import", record.sha256, record.attempt)
        position = await in_thread(services.queue.position, work)
    return held.apply(JSONResponse(field_document(record, prefix, position), headers=headers))


@get_and_head(
    router,
    "/fields/{sha256}/preview.png",
    summary="A picture of a field",
    response_class=Response,
    responses=_PICTURE_ANSWERS,
)
async def get_field_preview(
    request: Request, sha256: str, services: ServicesDep, caller: CallerDep, held: IfNoneMatchDep
) -> Response:
    """The surface from two sides, and a section with lines of equal distance. Orange is inside.

    A worker makes it after the import, like the mesh.
    """
    record = await in_thread(require_field, services, caller, sha256)
    return await _view_answer(request, services, record, (PICTURE_NAME,), "image/png", held)


@get_and_head(
    router,
    "/fields/{sha256}/mesh.glb",
    summary="A field's surface as a mesh for display",
    response_class=Response,
    responses={
        200: {"description": "Triangles in the field's frame and unit.", "content": {"model/gltf-binary": BINARY}},
        304: NOT_MODIFIED,
        **refusals("INVALID_QUERY", "FIELD_NOT_FOUND", "FIELD_VIEW_NOT_FOUND"),
    },
)
async def get_field_mesh(
    request: Request,
    sha256: str,
    services: ServicesDep,
    caller: CallerDep,
    held: IfNoneMatchDep,
    detail: Annotated[
        Literal["fine", "coarse"], Query(description="Level of detail: at most 200,000 triangles, or at most 30,000.")
    ] = "fine",
) -> Response:
    """The mesh is for display. It is flat-shaded if the field is a mesh, and has vertex colors if the field has colors.

    A worker makes it when the field is ready and no job is waiting. Until then the field's `views` is `pending`, and
    the 404 has `Retry-After`. A small surface has one mesh for both levels of detail. `POST /render` makes a `.glb`
    with the resolution of the request.
    """
    record = await in_thread(require_field, services, caller, sha256)
    fine, coarse = MESH_NAMES
    names = (coarse, fine) if detail == "coarse" else (fine,)
    return await _view_answer(request, services, record, names, "model/gltf-binary", held)


@get_and_head(
    router,
    "/fields/{sha256}/candidates/{number}.png",
    summary="A picture of one reading of an ambiguous file",
    response_class=Response,
    responses=_PICTURE_ANSWERS,
)
async def get_candidate_picture(
    request: Request,
    sha256: str,
    number: Annotated[str, Path(description="Number of the candidate in the field's error, from 1.")],
    services: ServicesDep,
    caller: CallerDep,
    held: IfNoneMatchDep,
) -> Response:
    """One of the `candidates` in the field's error. It is there while the upload is kept (`kept_until`)."""
    record = await in_thread(require_field, services, caller, sha256)
    if number not in _NUMBERS or not record.has_candidate_picture(int(number)):
        raise Problem("FIELD_VIEW_NOT_FOUND")
    headers = {"ETag": field_etag(record), "Cache-Control": "private, no-cache"}
    try:
        key = candidate_key(record.sha256, int(number))
        return await file_answer(request, services.blobs, key, "image/png", headers, held)
    except FileNotFoundError as error:
        raise Problem("FIELD_VIEW_NOT_FOUND") from error


async def _view_answer(
    request: Request,
    services: Services,
    record: FieldRecord,
    names: Sequence[str],
    media_type: str,
    held: IfNoneMatch,
) -> Response:
    """The first of the files ``names`` that a ready field has. Raises Problem FIELD_VIEW_NOT_FOUND."""
    headers = {"ETag": field_etag(record), "Cache-Control": _PRIVATE_HOUR}
    for name in names if record.state == "ready" else ():
        with suppress(FileNotFoundError):
            key = view_key(record.sha256, name)
            return await file_answer(request, services.blobs, key, media_type, headers, held)
    raise await in_thread(missing_view, services, record)


@router.get(
    "/fields",
    summary="Fields, newest first",
    response_model=FieldPage,
    responses={200: {"content": HTML}, **refusals("INVALID_QUERY")},
)
@blocking
def list_fields(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
    label: Annotated[str | None, Query(max_length=200, description="Only fields with this label.")] = None,
) -> Response:
    """A page may be short or empty although more pages follow. Continue while there is a `next_page_token`.

    A browser gets a page, which needs no token.
    """
    if wants_page(request.scope):
        return page("lists.html")
    found = services.records.list_fields(label, limit, decode_token(page_token), caller, recordings=False)
    documents = [field_document(record, prefix) for record in found.records]
    document = {"fields": documents, "next_page_token": encode_token(found.rest)}
    return JSONResponse(document, headers={"Vary": "Accept"})


@router.patch(
    "/fields/{sha256}",
    summary="Change a field's import options",
    response_model=FieldDocument,
    status_code=200,
    responses={
        200: {"description": "Only the label has changed, or nothing.", "headers": {"ETag": header("For GET.")}},
        202: {"description": "The kept file is imported again.", "model": FieldDocument, "links": FIELD_LINKS},
        **refusals(
            "INVALID_HEADER MALFORMED_JSON UPLOAD_INCOMPLETE TOO_MANY_REQUESTS_AT_ONCE REQUEST_TOO_LARGE "
            "UNSUPPORTED_MEDIA_TYPE INVALID_REQUEST INVALID_DESCRIPTION FIELD_NOT_FOUND FIELD_VALIDATING FIELD_IN_USE "
            "FIELD_BYTES_GONE RECORDING_UNSUITABLE CONFLICT QUOTA_ACTIVE_JOBS"
        ),
    },
    openapi_extra={"requestBody": {"required": True, "content": {JSON: _CHANGE}}},
)
async def patch_field(
    sha256: str, request: Request, services: ServicesDep, caller: CallerDep, prefix: PrefixDep
) -> JSONResponse:
    """Changes the import options without a second upload, while the file is kept (`kept_until`).

    Different import options can give a different field from the same file, so the call is refused while an active job
    uses the field. The body may also be sent as `application/merge-patch+json`.
    """
    if body.media_type(request) not in _PATCHES:
        raise Problem("UNSUPPORTED_MEDIA_TYPE", f"Send {' or '.join(_PATCHES)}.")
    change = await read_json(request, services, caller, FieldChange)
    record, imported = await in_thread(_changed, services, caller, sha256, change)
    headers = {"ETag": field_etag(record)} | ({"Retry-After": "1"} if imported else {})
    return JSONResponse(field_document(record, prefix), status_code=202 if imported else 200, headers=headers)


def _changed(services: Services, caller: str, sha256: str, change: FieldChange) -> tuple[FieldRecord, bool]:
    known = require_field(services, caller, sha256)
    if known.is_recording:
        raise Problem("RECORDING_UNSUITABLE")
    said = _described_anew(known, change.description_change(known.said))
    label = change.label if "label" in change.model_fields_set else (said.label or known.label)
    imported = redescribe(services, caller, known, said, label)
    return require_field(services, caller, sha256), imported


def _described_anew(known: FieldRecord, change: Mapping[str, Any]) -> UploadDescription:
    """What is said of a field after a change as RFC 7396 has it. Raises Problem INVALID_DESCRIPTION."""
    merged = _merged(known.said, change)
    try:
        return read_model(UploadDescription, json.dumps(merged).encode(), "INVALID_DESCRIPTION")
    except Problem as problem:
        faults = [{**fault, "pointer": "/description" + fault.get("pointer", "")} for fault in problem.errors]
        raise Problem(problem.reason, problem.detail, errors=faults, hint=problem.hint) from problem


def _merged(held: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(held)
    for name, value in change.items():
        if value is None:
            merged.pop(name, None)
        elif isinstance(value, dict):
            inner = merged.get(name)
            merged[name] = _merged(inner if isinstance(inner, dict) else {}, value)
        else:
            merged[name] = value
    return merged


@router.delete(
    "/fields/{sha256}",
    summary="Delete a field and its file",
    status_code=204,
    response_class=Response,
    responses=refusals("FIELD_NOT_FOUND", "FIELD_IN_USE", "FIELD_IN_LIBRARY"),
)
@blocking
def delete_field(sha256: str, services: ServicesDep, caller: CallerDep) -> Response:
    """The call is refused while an active job needs the field, or while it is in the library. Results of finished jobs
    are kept. The pieces of an unfinished upload are deleted too.
    """
    if is_sha256(sha256) and services.pieces.find(caller, sha256).pieces:
        services.pieces.drop(caller, sha256)
        if services.records.get_field(reference_of(caller, sha256)) is None:
            return Response(status_code=204)
    field = require_field(services, caller, sha256)
    reference = field.sha256
    if field.library is not None:
        raise Problem("FIELD_IN_LIBRARY")
    if next(iter(services.records.jobs_using_field(reference)), None) is not None:
        raise Problem("FIELD_IN_USE")
    services.records.delete_field(reference)
    services.queue.drop_import(reference, field.attempt)
    services.blobs.delete_prefix(f"fields/{reference}")
    return Response(status_code=204)

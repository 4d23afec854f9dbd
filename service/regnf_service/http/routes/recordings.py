"""Recordings: frames of a depth camera, stored, owned and limited as fields are."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AsyncExitStack
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from regnf_service.concurrency import PARSING, blocking, in_thread
from regnf_service.fields.ingest import StoredUpload, room_for_bytes, store_upload
from regnf_service.fields.uploads import Received
from regnf_service.http import body
from regnf_service.http.body import (
    CallerDep,
    LimitQuery,
    PageTokenQuery,
    PrefixDep,
    ServicesDep,
    WaitQuery,
    boundary_of,
    read_parts,
    wait_for,
)
from regnf_service.http.middleware import fair_key
from regnf_service.http.query import decode_token, encode_token
from regnf_service.http.ranges import IfNoneMatchDep, announced_digest, field_etag
from regnf_service.http.routes.documentation import (
    BINARY,
    FILE,
    MULTIPART_REFUSALS,
    NOT_MODIFIED,
    UPLOAD_REFUSALS,
    get_and_head,
    header,
    links,
    refusals,
)
from regnf_service.http.routes.fields import forget, require_upload
from regnf_service.http.routes.uploads import compared, receive_raw
from regnf_service.http.schemas.recordings import RecordingDocument, RecordingPage, recording_document
from regnf_service.http.schemas.results import Label
from regnf_service.http.strict_json import parse_json
from regnf_service.problem import Problem
from regnf_service.recordings.pictures import frame_picture
from regnf_service.recordings.uploads import (
    CAMERA_BYTES,
    FRAME_BYTES,
    NAME_BYTES,
    AsRecording,
    FrameUpload,
    RecordingUpload,
    frame_name,
)
from regnf_service.services import Services
from regnf_state.pieces import view_key
from regnf_state.queue import Work
from regnf_state.records import FieldRecord

router = APIRouter(tags=["recordings"])
_LINKS = links("sha256", "/sha256", "get_recording", "delete_recording")
_HEADERS = {"Location": header("The recording."), "ETag": header("Changes whenever the document does.")}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The bytes were held already.",
        "model": RecordingDocument,
        "headers": _HEADERS,
        "links": _LINKS,
    },
    201: {"description": "Stored; the import is queued.", "headers": _HEADERS, "links": _LINKS},
    **refusals(
        UPLOAD_REFUSALS.replace("FIELD_NOT_RECOGNIZED", "RECORDING_NOT_RECOGNIZED"),
        MULTIPART_REFUSALS,
        "MALFORMED_JSON FIELD_DESCRIPTION_DIFFERS INVALID_QUERY",
    ),
}
_CAMERA = {
    "type": "object",
    "description": "The intrinsics, in any form that a folder's `camera.json` may have; `depth_unit`, meters a step, "
    "and `T_world_camera`, 4x4, if they are known.",
}
FRAME_PARTS: dict[str, Any] = {"depth": FILE, "color": FILE, "camera": _CAMERA}
LabelQuery = Annotated[Label | None, Query(description="A name for people.")]
DigestHeader = Annotated[str | None, Header(description="RFC 9530, of the body as sent.")]


def _form(required: tuple[str, ...], **more: Any) -> dict[str, Any]:
    schema = {"type": "object", "required": list(required), "additionalProperties": False}
    return {"multipart/form-data": {"schema": schema | {"properties": FRAME_PARTS | more}}}


@router.post(
    "/recordings",
    summary="Upload a recording, or one frame",
    response_model=RecordingDocument,
    status_code=201,
    responses=_ANSWERS,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/octet-stream": {"schema": FILE}, **_form(("depth", "camera"))},
        }
    },
)
async def post_recording(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    label: LabelQuery = None,
    content_digest: DigestHeader = None,
) -> JSONResponse:
    """An archive of a folder, a bag (ROS, MCAP) or a stored recording as the body; or one frame in parts.

    `depth` is a PNG of 16 bits, a TIFF or a `.npy` file, `color` an image by the same camera. The answer's `sha256`
    names the recording: `POST /register` takes it as `scene`. The same parts in the same order are the same recording.
    """
    return _answer(await _taken(request, services, caller, content_digest, AsRecording(name=label)), prefix)


@router.post(
    "/recordings/{sha256}/frames",
    summary="Add a frame to a recording",
    response_model=RecordingDocument,
    status_code=201,
    responses={
        **_ANSWERS,
        **refusals(
            UPLOAD_REFUSALS.replace("FIELD_NOT_RECOGNIZED", "RECORDING_NOT_RECOGNIZED"),
            MULTIPART_REFUSALS,
            "MALFORMED_JSON FIELD_DESCRIPTION_DIFFERS RECORDING_NOT_FOUND FIELD_VALIDATING FIELD_REJECTED "
            "INVALID_REQUEST",
        ),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": _form(
                ("depth", "camera", "name"), name={"type": "string", "pattern": "^[A-Za-z0-9._-]{1,100}$"}
            ),
        }
    },
)
async def post_frame(
    sha256: str,
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    content_digest: DigestHeader = None,
) -> JSONResponse:
    """Answers with the new recording, under an id of its own: all frames before, and this one, called `name`.

    The earlier recording stays as it is until it is deleted. It must be `ready`. Both have one world: the frame's
    `camera` says `T_world_camera`.
    """
    known = await in_thread(require_upload, services, caller, sha256, True)
    if known.state == "validating":
        raise Problem("FIELD_VALIDATING", headers={"Retry-After": "1"})
    if known.state == "rejected":
        raise Problem("FIELD_REJECTED")
    as_ = AsRecording(name=known.label, said={"after": sha256})
    return _answer(await _taken(request, services, caller, content_digest, as_), prefix)


async def _taken(
    request: Request, services: Services, caller: str, content_digest: str | None, as_: AsRecording
) -> StoredUpload:
    """Take the body in. Nothing is kept before all of it has arrived."""
    kind, digest = body.media_type(request), announced_digest(content_digest)
    in_parts = kind == "multipart/form-data"
    if kind.startswith("text/") or (as_.said and not in_parts):
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/octet-stream or multipart/form-data.")
    declared = body.declared_length(request)
    async with AsyncExitStack() as stack:
        stack.enter_context(services.uploads.held(fair_key(request.scope, caller)))
        room = await in_thread(room_for_bytes, services, caller)
        claim = stack.enter_context(services.under_way.claim(caller, room, declared))
        if in_parts:
            frame = await stack.enter_async_context(FrameUpload(services, claim))
            received, as_ = await _receive_frame(request, frame, digest, as_)
            return await store_upload(services, caller, frame, received, as_)
        upload = await stack.enter_async_context(RecordingUpload(services, claim))
        received = await receive_raw(request, services, upload, digest)
        return await store_upload(services, caller, upload, received, as_)


async def _receive_frame(
    request: Request, frame: FrameUpload, digest: str | None, as_: AsRecording
) -> tuple[Received, AsRecording]:
    body.refuse_encoding(request)
    data = body.chunks(request, FRAME_BYTES + 2 * CAMERA_BYTES)
    texts = {"camera": CAMERA_BYTES} | ({"name": NAME_BYTES} if as_.said else {})
    parts = await read_parts(
        data if digest is None else compared(data, digest), boundary_of(request), frame.parts, texts
    )
    missing = [name for name in ("depth", *texts) if name not in parts]
    if missing:
        raise Problem("MALFORMED_MULTIPART", f"The part `{missing[0]}` is missing.")
    if as_.said:
        as_ = AsRecording(name=as_.name, said={**as_.said, "frame": frame_name(parts["name"])})
    return await frame.finish_frame(camera_of(parts), as_.said or None), as_


def camera_of(parts: Mapping[str, bytes]) -> bytes:
    """The part `camera`, which is a JSON object. Raises Problem MALFORMED_JSON."""
    if not isinstance(parse_json(parts["camera"], what="The part `camera`"), dict):
        raise Problem("MALFORMED_JSON", "The part `camera` is not an object.")
    return parts["camera"]


def _answer(taken: StoredUpload, prefix: str) -> JSONResponse:
    document = recording_document(taken.record, prefix)
    headers = {"Location": document["links"]["self"], "ETag": field_etag(taken.record)}
    return JSONResponse(document, status_code=201 if taken.created else 200, headers=headers)


@router.get(
    "/recordings",
    summary="Recordings, newest first",
    response_model=RecordingPage,
    responses=refusals("INVALID_QUERY"),
)
@blocking
def list_recordings(
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
    label: LabelQuery = None,
) -> Response:
    """A page may be short or empty and not be the last: go on while there is a `next_page_token`."""
    found = services.records.list_fields(label, limit, decode_token(page_token), caller, recordings=True)
    documents = [recording_document(record, prefix) for record in found.records]
    return JSONResponse({"recordings": documents, "next_page_token": encode_token(found.rest)})


@get_and_head(
    router,
    "/recordings/{sha256}",
    summary="A recording's state and what its import found",
    response_model=RecordingDocument,
    responses={
        200: {"headers": {"ETag": header("For If-None-Match.")}},
        304: NOT_MODIFIED,
        **refusals("INVALID_QUERY", "RECORDING_NOT_FOUND"),
    },
)
async def get_recording(
    sha256: str,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    held: IfNoneMatchDep,
    wait: WaitQuery = 0,
) -> Response:
    """As `GET /fields/{sha256}`: with `wait`, once it is not `validating`."""

    def is_news(found: FieldRecord) -> bool:
        return found.state != "validating" or held.differs(field_etag(found))

    record = await wait_for(lambda: require_upload(services, caller, sha256, True), is_news, wait, services, caller)
    headers = {"ETag": field_etag(record), "Cache-Control": "no-cache"}
    position = None
    if record.state == "validating":
        headers["Retry-After"] = "1"
        position = await in_thread(services.queue.position, Work("import", record.sha256, record.attempt))
    return held.apply(JSONResponse(recording_document(record, prefix, position), headers=headers))


@get_and_head(
    router,
    "/recordings/{sha256}/frames/{name:path}/color.png",
    summary="A frame's color image, or its depth as gray",
    response_class=Response,
    responses={
        200: {"description": "Of the image's own size.", "content": {"image/png": BINARY}},
        304: NOT_MODIFIED,
        **refusals("RECORDING_NOT_FOUND", "RECORDING_FRAME_NOT_FOUND"),
    },
)
async def get_frame_picture(
    sha256: str, name: str, services: ServicesDep, caller: CallerDep, held: IfNoneMatchDep
) -> Response:
    """`name` is the frame's name, or its number. Detections are in pixels of this image.

    Depth is brighter where it is farther, and black where nothing was measured.
    """
    record = await in_thread(require_upload, services, caller, sha256, True)
    headers = {"ETag": field_etag(record), "Cache-Control": "private, max-age=3600"}
    answer = held.apply(Response(headers=headers))
    if answer.status_code == 304:
        return answer
    if record.state != "ready":
        raise Problem("RECORDING_FRAME_NOT_FOUND")
    picture = await PARSING.run(_picture, services, record, name)
    return Response(picture, media_type="image/png", headers=headers)


def _picture(services: Services, record: FieldRecord, name: str) -> bytes:
    try:
        with services.blobs.open(view_key(record.sha256, "field.safetensors")) as file:
            return frame_picture(file, name)
    except FileNotFoundError as error:
        raise Problem("RECORDING_FRAME_NOT_FOUND") from error


@router.delete(
    "/recordings/{sha256}",
    summary="Forget a recording and its bytes",
    status_code=204,
    response_class=Response,
    responses=refusals("RECORDING_NOT_FOUND", "FIELD_IN_USE"),
)
@blocking
def delete_recording(sha256: str, services: ServicesDep, caller: CallerDep) -> Response:
    """Refused while an active job needs the recording. Results of finished jobs stay."""
    forget(services, require_upload(services, caller, sha256, True))
    return Response(status_code=204)

"""Recordings: frames of a depth camera, stored, owned, limited and shown as fields are."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import AsyncExitStack
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from regnf_core.importing.recording_description import RecordingDescription
from regnf_service.concurrency import PARSING, blocking, in_thread
from regnf_service.fields.ingest import StoredUpload, room_for_bytes, store_upload
from regnf_service.fields.piecewise import finish_pieces
from regnf_service.http import body
from regnf_service.http.body import (
    CallerDep,
    LimitQuery,
    PageTokenQuery,
    PrefixDep,
    ServicesDep,
    Sink,
    boundary_of,
    read_parts,
)
from regnf_service.http.middleware import fair_key
from regnf_service.http.query import decode_token, encode_token
from regnf_service.http.ranges import IfNoneMatchDep, announced_digest, field_etag
from regnf_service.http.routes.documentation import (
    BINARY,
    FILE,
    MULTIPART_REFUSALS,
    NOT_MODIFIED,
    PIECE_REFUSALS,
    UPLOAD_REFUSALS,
    get_and_head,
    refusals,
)
from regnf_service.http.routes.fields import FIELD_ANSWERS, delete_field, get_field, require_field
from regnf_service.http.routes.uploads import (
    ANSWERS,
    DESCRIPTION_BYTES,
    UPLOAD_BYTES,
    UPLOAD_PART,
    compared,
    named_upload,
    read_description,
    receive_raw,
    upload_answer,
)
from regnf_service.http.schemas.fields import FieldDocument, RecordingPage, field_document
from regnf_service.http.schemas.reading import reference
from regnf_service.http.schemas.results import Label
from regnf_service.http.strict_json import parse_json
from regnf_service.problem import Problem
from regnf_service.recordings.pictures import frame_picture
from regnf_service.recordings.uploads import CAMERA_BYTES, FRAME_BYTES, AsRecording, FrameUpload, RecordingUpload
from regnf_service.services import Services
from regnf_state.pieces import view_key
from regnf_state.records import FieldRecord

router = APIRouter(tags=["recordings"])
_REFUSALS = (
    f"{UPLOAD_REFUSALS.replace('FIELD_NOT', 'RECORDING_NOT')} {MULTIPART_REFUSALS} {PIECE_REFUSALS} MALFORMED_JSON "
    "FIELD_DESCRIPTION_DIFFERS INVALID_DESCRIPTION INVALID_QUERY"
)
FRAME_PARTS: dict[str, Any] = {
    "depth": FILE | {"description": "The depth image: a 16-bit PNG, a TIFF or a `.npy` file."},
    "color": FILE | {"description": "The color image of the same view: a PNG, JPEG, BMP or WebP file."},
    "camera": {
        "type": "object",
        "description": "The intrinsics, in the form of a `camera.json`. It may also have `depth_unit` (meters per "
        "step) and `T_world_camera` (4x4).",
    },
}
_WHOLE = {"file": FILE, "upload": UPLOAD_PART}
_NAME = r"[A-Za-z0-9._-]{1,100}"
LabelQuery = Annotated[Label | None, Query(description="A name for display.")]
DigestHeader = Annotated[str | None, Header(description="RFC 9530: the digest of the body as sent.")]


def _body(required: list[str], **more: Any) -> dict[str, Any]:
    parts = {**FRAME_PARTS, "description": reference(RecordingDescription), **more}
    form = {"type": "object", "required": required, "additionalProperties": False, "properties": parts}
    files = {} if required else {"application/octet-stream": {"schema": FILE}}
    return {"requestBody": {"required": True, "content": {**files, "multipart/form-data": {"schema": form}}}}


@router.post(
    "/recordings",
    summary="Upload a recording, or one frame",
    response_model=FieldDocument,
    status_code=201,
    responses={**ANSWERS, **refusals(_REFUSALS)},
    openapi_extra=_body([], **_WHOLE),
)
async def post_recording(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    label: LabelQuery = None,
    content_digest: DigestHeader = None,
) -> JSONResponse:
    """The body or the part `file` is an archive of a folder, a bag (ROS, MCAP) or a stored recording. Or the parts are
    one frame.

    The `sha256` in the response identifies the recording: `POST /register` takes it as `scene`. The same parts in the
    same order are the same recording. `upload`, in place of `file`, names a file that was uploaded in pieces with `PUT
    /fields/{sha256}`. `description` has import options that are in no file.
    """
    return upload_answer(await _taken(request, services, caller, content_digest, AsRecording(name=label)), prefix)


@router.post(
    "/recordings/{sha256}/frames",
    summary="Add a frame to a recording",
    response_model=FieldDocument,
    status_code=201,
    responses={**ANSWERS, **refusals(_REFUSALS, "FIELD_NOT_FOUND FIELD_VALIDATING FIELD_REJECTED INVALID_REQUEST")},
    openapi_extra=_body(["depth", "camera", "name"], name={"type": "string", "pattern": f"^{_NAME}$"}),
)
async def post_frame(
    sha256: str,
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    content_digest: DigestHeader = None,
) -> JSONResponse:
    """Creates another recording: all frames of this one, which must be `ready`, and the new frame with the name `name`.

    This recording is kept until it is deleted. The frame's `camera` has `T_world_camera` in the same world frame.
    """
    known = await in_thread(require_field, services, caller, sha256)
    if known.state != "ready" or not known.is_recording:
        raise Problem({"validating": "FIELD_VALIDATING", "rejected": "FIELD_REJECTED"}.get(known.state, "NOT_FOUND"))
    as_ = AsRecording(name=known.label, said={"after": sha256})
    return upload_answer(await _taken(request, services, caller, content_digest, as_), prefix)


async def _taken(
    request: Request, services: Services, caller: str, content_digest: str | None, as_: AsRecording
) -> StoredUpload:
    """Take the body in. Nothing is kept before all of it has arrived."""
    kind, digest = body.media_type(request), announced_digest(content_digest)
    in_parts = kind == "multipart/form-data"
    if kind.startswith("text/") or (as_.said and not in_parts):
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/octet-stream or multipart/form-data.")
    declared = body.declared_length(request, besides=CAMERA_BYTES + DESCRIPTION_BYTES if in_parts else 0)
    async with AsyncExitStack() as stack:
        stack.enter_context(services.uploads.held(fair_key(request.scope, caller)))
        room = await in_thread(room_for_bytes, services, caller)
        claim = stack.enter_context(services.under_way.claim(caller, room, declared))
        upload = await stack.enter_async_context(RecordingUpload(services, claim))
        if not in_parts:
            received = await receive_raw(request, services, upload, digest)
            return await store_upload(services, caller, upload, received, as_)
        frame = await stack.enter_async_context(FrameUpload(services, claim))
        most = max(FRAME_BYTES, services.settings.max_upload_bytes)
        parts = await _receive_parts(request, {"file": upload, **frame.images}, most, digest)
        said = read_description(parts.pop("description", None), RecordingDescription)
        as_ = AsRecording(name=as_.name, said={**as_.said, **({} if said is None else said.non_default())})
        adds = "after" in as_.said
        if parts.keys() == {"upload"} and not adds:
            return await finish_pieces(services, caller, named_upload(parts["upload"]), as_, RecordingUpload)
        if parts.keys() == {"file"} and not adds:
            return await store_upload(services, caller, upload, await upload.finish(), as_)
        wanted = ["camera", "depth"] + (["name"] if adds else [])
        if sorted(parts.keys() - {"color"}) != wanted:
            raise Problem("MALFORMED_MULTIPART", f"Send the parts {', '.join(wanted)}, and optionally color.")
        texts = {"camera.json": camera_of(parts)}
        if adds:
            name = parts["name"].decode("utf-8", "replace")
            if not re.fullmatch(_NAME, name):
                raise Problem("INVALID_REQUEST", f"The part `name` is not {_NAME}.")
            as_ = AsRecording(name=as_.name, said={**as_.said, "frame": name})
            texts["frame.json"] = json.dumps(as_.said).encode()
        return await store_upload(services, caller, frame, await frame.finish_frame(texts), as_)


async def _receive_parts(
    request: Request, files: Mapping[str, Sink], most: int, digest: str | None
) -> dict[str, bytes]:
    body.refuse_encoding(request)
    data = body.chunks(request, most + 2 * CAMERA_BYTES + DESCRIPTION_BYTES)
    texts = {"camera": CAMERA_BYTES, "description": DESCRIPTION_BYTES, "name": UPLOAD_BYTES, "upload": UPLOAD_BYTES}
    return await read_parts(data if digest is None else compared(data, digest), boundary_of(request), files, texts)


def camera_of(parts: Mapping[str, bytes]) -> bytes:
    """The part `camera`. Raises Problem MALFORMED_JSON unless it is a JSON object."""
    if not isinstance(parse_json(parts["camera"], what="The part `camera`"), dict):
        raise Problem("MALFORMED_JSON", "The part `camera` is not an object.")
    return parts["camera"]


@router.get("/recordings", summary="Recordings, newest first", response_model=RecordingPage,
            responses=refusals("INVALID_QUERY"))  # fmt: skip
@blocking
def list_recordings(
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
    label: LabelQuery = None,
) -> Response:
    """A page may be short or empty although more pages follow. Continue while there is a `next_page_token`."""
    found = services.records.list_fields(label, limit, decode_token(page_token), caller, recordings=True)
    documents = [field_document(record, prefix) for record in found.records]
    return JSONResponse({"recordings": documents, "next_page_token": encode_token(found.rest)})


get_and_head(
    router,
    "/recordings/{sha256}",
    name="get_recording",
    summary="State of a recording and report of its import",
    response_model=FieldDocument,
    responses=FIELD_ANSWERS,
)(get_field)
router.delete(
    "/recordings/{sha256}",
    name="delete_recording",
    summary="Delete a recording and its file",
    status_code=204,
    response_class=Response,
    responses=refusals("FIELD_NOT_FOUND", "FIELD_IN_USE", "FIELD_IN_LIBRARY"),
)(delete_field)


@get_and_head(
    router,
    "/recordings/{sha256}/frames/{name:path}/color.png",
    summary="Color image of a frame, or its depth image in gray",
    response_class=Response,
    responses={
        200: {"description": "The image has its original size.", "content": {"image/png": BINARY}},
        304: NOT_MODIFIED,
        **refusals("FIELD_NOT_FOUND", "RECORDING_FRAME_NOT_FOUND"),
    },
)
async def get_frame_picture(
    sha256: str, name: str, services: ServicesDep, caller: CallerDep, held: IfNoneMatchDep
) -> Response:
    """`name` is the frame's name, or its number. Detections are in pixels of this image. In a depth image farther
    points are brighter, and pixels without a measurement are black.
    """
    record = await in_thread(require_field, services, caller, sha256)
    headers = {"ETag": field_etag(record), "Cache-Control": "private, max-age=3600"}
    if held.matches(headers["ETag"]):
        return held.apply(Response(headers=headers))
    picture = await PARSING.run(_picture, services, record, name)
    return Response(picture, media_type="image/png", headers=headers)


def _picture(services: Services, record: FieldRecord, name: str) -> bytes:
    try:
        if record.is_recording and record.state == "ready":
            with services.blobs.open(view_key(record.sha256, "field.safetensors")) as file:
                return frame_picture(file, name)
    except FileNotFoundError:
        pass  # it was deleted
    raise Problem("RECORDING_FRAME_NOT_FOUND")

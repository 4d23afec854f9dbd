"""PUT /fields/{sha256} and POST /fields: the bytes of a field."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack
from typing import Annotated, Any, Literal, TypeVar

from fastapi import APIRouter, Header, Path
from starlette.requests import Request
from starlette.responses import JSONResponse

from regnf_core.importing.upload_description import UploadDescription
from regnf_core.texts import TextError, decode_text
from regnf_service.concurrency import in_thread
from regnf_service.fields.ingest import Beside, StoredUpload, check_room, held_field, room_for_bytes, store_upload
from regnf_service.fields.piecewise import PieceRange, PieceUpload, check_piece, finish_pieces
from regnf_service.fields.uploads import Received, SettingsUpload, Upload, settings_limit
from regnf_service.http import body
from regnf_service.http.body import (
    CallerDep,
    PrefixDep,
    ServicesDep,
    boundary_of,
    read_parts,
)
from regnf_service.http.middleware import fair_key
from regnf_service.http.ranges import PATTERN, announced_digest, content_range, field_etag, is_sha256
from regnf_service.http.routes.documentation import (
    FIELD_LINKS,
    FILE,
    MULTIPART_REFUSALS,
    PIECE_REFUSALS,
    UPLOAD_REFUSALS,
    header,
    refusals,
)
from regnf_service.http.schemas.fields import FieldDocument, UploadProgress, field_document
from regnf_service.http.schemas.reading import read_model, reference
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.records import FieldRecord

router = APIRouter(tags=["fields"])
DESCRIPTION_BYTES = 16 * 1024
_BESIDE = ("settings", "cameras")
UPLOAD_BYTES = 4 * (64 + 4)
"""A digest in any encoding, with a mark and the end of its line."""
_HEADERS = {"Location": header("The field."), "ETag": header("Changes whenever the document changes.")}
_DIGEST = {"pattern": "^sha-256=:[A-Za-z0-9+/]{43}=:$"}
ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The service already has the file.",
        "model": FieldDocument,
        "headers": _HEADERS,
        "links": FIELD_LINKS,
    },
    201: {"description": "Stored; the import is queued.", "headers": _HEADERS, "links": FIELD_LINKS},
}
UPLOAD_PART = {
    "type": "string",
    "pattern": "^[0-9a-f]{64}$",
    "description": "In place of `file`: a file that was uploaded in pieces.",
}
_MULTIPART = {
    "schema": {
        "type": "object",
        "additionalProperties": False,
        "properties": {
            "file": FILE,
            "upload": UPLOAD_PART,
            "description": reference(UploadDescription),
            "settings": FILE,
            "cameras": FILE,
        },
    }
}


@router.put(
    "/fields/{sha256}",
    summary="Upload a field with a known SHA-256",
    response_model=FieldDocument,
    status_code=201,
    responses={
        **ANSWERS,
        202: {
            "description": "The piece is stored. More pieces are needed.",
            "model": UploadProgress,
            "headers": {"Upload-Offset": header("Number of bytes that have arrived.")},
        },
        **refusals(UPLOAD_REFUSALS, PIECE_REFUSALS),
    },
    openapi_extra={"requestBody": {"required": True, "content": {"application/octet-stream": {"schema": FILE}}}},
)
async def put_field(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    sha256: Annotated[str, Path(description="SHA-256 of the file.", json_schema_extra={"pattern": "^[0-9a-f]{64}$"})],
    content_digest: Annotated[
        str | None, Header(description="RFC 9530: `sha-256=:<base64>:`.", json_schema_extra=_DIGEST)
    ] = None,
    content_range_: Annotated[
        str | None,
        Header(
            alias="Content-Range",
            description="RFC 9110: the position of this piece in the file.",
            json_schema_extra={"pattern": PATTERN},
        ),
    ] = None,
    upload_complete: Annotated[
        Literal["?0", "?1"],
        Header(description="?0: the pieces are kept until a `POST /fields` names them in its part `upload`."),
    ] = "?1",
) -> JSONResponse:
    """The body is the unchanged file: a checkpoint, a map, a grid or a mesh (docs/import-gate.md). The call can be
    repeated: it returns 200 if the service has the file.

    With `Content-Range: bytes first-last/total` the body is one piece of the file. Send the pieces in order. A complete
    piece is kept if the transfer of the next one fails. `bytes */total` without a body returns how many bytes have
    arrived. If all have arrived, it completes the upload.
    """
    if not is_sha256(sha256):
        raise Problem("INVALID_DIGEST")
    if body.media_type(request).startswith("multipart/"):
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "PUT needs only the bytes of the file as the body.")
    digest = announced_digest(content_digest)
    span = content_range(content_range_, services.settings.max_upload_bytes)
    declared = body.declared_length(request)
    with services.uploads.held(fair_key(request.scope, caller)):
        if span is not None:
            held = await _receive_piece(request, services, caller, sha256, span, digest)
            if held is not None:
                return upload_answer(StoredUpload(held, created=False), prefix)
            offset = (await in_thread(services.pieces.find, caller, sha256)).offset
            if upload_complete == "?0" or offset != span.total:
                document = UploadProgress(sha256=sha256, offset=offset, bytes=span.total).model_dump()
                return JSONResponse(document, status_code=202, headers={"Upload-Offset": str(offset)})
            return upload_answer(await finish_pieces(services, caller, sha256), prefix)
        room = await in_thread(check_room, services, caller, sha256)
        with services.under_way.claim(caller, room, declared) as claim:
            async with Upload(services, claim) as upload:
                received = await receive_raw(request, services, upload, digest)
                if received.sha256 != sha256:
                    raise Problem("DIGEST_MISMATCH")
                taken = await store_upload(services, caller, upload, received)
    return upload_answer(taken, prefix)


@router.post(
    "/fields",
    summary="Upload a field; the service computes its SHA-256",
    response_model=FieldDocument,
    status_code=201,
    responses={
        **ANSWERS,
        **refusals(
            UPLOAD_REFUSALS,
            MULTIPART_REFUSALS,
            PIECE_REFUSALS,
            "MALFORMED_JSON FIELD_DESCRIPTION_DIFFERS INVALID_DESCRIPTION",
        ),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/octet-stream": {"schema": FILE}, "multipart/form-data": _MULTIPART},
        }
    },
)
async def post_field(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    content_digest: Annotated[
        str | None, Header(description="RFC 9530: the digest of the body as sent.", json_schema_extra=_DIGEST)
    ] = None,
) -> JSONResponse:
    """The body is the file, or multipart with the part `file` and optional parts.

    `settings` is the trainer's config file, or a zip or tar file with several. `cameras` is a file with the poses of
    the cameras from whose images the field was made (docs/import-gate.md). `description` is JSON with import options
    that are in no file. An archive of a whole training run needs none of them. `upload` names a file that was uploaded
    in pieces with PUT.
    """
    if body.media_type(request).startswith("text/"):
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/octet-stream or multipart/form-data.")
    digest = announced_digest(content_digest)
    in_parts = body.media_type(request) == "multipart/form-data"
    declared = body.declared_length(request, besides=2 * DESCRIPTION_BYTES if in_parts else 0)
    async with AsyncExitStack() as stack:
        stack.enter_context(services.uploads.held(fair_key(request.scope, caller)))
        room = await in_thread(room_for_bytes, services, caller)
        claim = stack.enter_context(services.under_way.claim(caller, room, declared))
        upload = await stack.enter_async_context(Upload(services, claim))
        if in_parts:
            files = {part: await stack.enter_async_context(SettingsUpload(services, claim)) for part in _BESIDE}
            received, beside = await _receive_parts(request, services, upload, files, digest)
            if isinstance(received, str):
                return upload_answer(await finish_pieces(services, caller, received, beside), prefix)
        else:
            received, beside = await receive_raw(request, services, upload, digest), Beside()
        taken = await store_upload(services, caller, upload, received, beside)
    return upload_answer(taken, prefix)


async def _receive_piece(
    request: Request, services: Services, caller: str, sha256: str, span: PieceRange, digest: str | None
) -> FieldRecord | None:
    """Read one piece to its end, and keep it if it is wanted; the field, if the caller has it already.

    Raises Problem as ``check_piece``, UPLOAD_INCOMPLETE, DIGEST_MISMATCH.
    """
    room = await in_thread(check_room, services, caller, sha256)
    known = await in_thread(held_field, services, caller, sha256)
    if known is None:
        await in_thread(check_piece, services, caller, sha256, span)
    body.refuse_encoding(request)
    data = body.chunks(request, span.length, too_large="INVALID_HEADER")  # more than Content-Range says
    if span.first is None:
        async for _ in data:
            pass
        return known
    with services.under_way.claim(caller, room, span.length) as claim:
        async with PieceUpload(services, claim, span) as upload:
            async for block in data:
                await upload.feed(block)
            received = await upload.finish()
            if digest not in (None, received.sha256):
                raise Problem("DIGEST_MISMATCH")
            if known is None:
                if received.bytes != span.length:
                    raise Problem("UPLOAD_INCOMPLETE", "The length of the body differs from Content-Range.")
                await in_thread(services.pieces.make_room, caller, sha256, span.first + received.bytes)
                await upload.commit(services.pieces.key(caller, sha256, span.first, span.total))
    return known


async def receive_raw(request: Request, services: Services, upload: Upload, digest: str | None) -> Received:
    """A body that is one file, whole. Raises Problem, DIGEST_MISMATCH where it is not of the announced digest."""
    body.refuse_encoding(request)
    async for data in body.chunks(request, services.settings.max_upload_bytes):
        await upload.feed(data)
    received = await upload.finish()
    if digest not in (None, received.sha256):
        raise Problem("DIGEST_MISMATCH")
    return received


async def _receive_parts(
    request: Request,
    services: Services,
    upload: Upload,
    beside: Mapping[str, SettingsUpload],
    digest: str | None,
) -> tuple[Received | str, Beside]:
    """What came. In place of the file it may be the SHA-256 of one whose pieces came before."""
    body.refuse_encoding(request)
    limit = services.settings.max_upload_bytes + len(beside) * settings_limit(services) + 2 * DESCRIPTION_BYTES
    data = body.chunks(request, limit)
    if digest is not None:
        data = compared(data, digest)
    texts = {"description": DESCRIPTION_BYTES, "upload": UPLOAD_BYTES}
    files = {"file": upload, **beside}
    parts = await read_parts(data, boundary_of(request), files, texts)
    if ("file" in parts) == ("upload" in parts):
        raise Problem("MALFORMED_MULTIPART", "Send the part `file` or the part `upload`.")
    description = read_description(parts.get("description"))
    settings, cameras = [await beside[part].received() for part in _BESIDE]
    if "file" in parts:
        return await upload.finish(), Beside(description, settings, cameras)
    return named_upload(parts["upload"]), Beside(description, settings, cameras)


def named_upload(text: bytes) -> str:
    """The SHA-256 that the part `upload` names. Raises Problem INVALID_DIGEST."""
    try:
        named = decode_text(text).strip()
    except TextError as error:
        raise Problem("INVALID_DIGEST", f"The part `upload` is {error}.") from error
    if not is_sha256(named):
        raise Problem("INVALID_DIGEST")
    return named


_Described = TypeVar("_Described")


def read_description(text: bytes | None, kind: type[_Described] = UploadDescription) -> _Described | None:  # type: ignore[assignment]
    """What a part says of a file. Raises Problem MALFORMED_JSON, INVALID_DESCRIPTION."""
    return None if text is None else read_model(kind, text, "INVALID_DESCRIPTION", what="The part `description`")


async def compared(data: AsyncIterator[bytes], digest: str) -> AsyncIterator[bytes]:
    """The body as it comes. Raises Problem DIGEST_MISMATCH at its end: the digest is of the parts and all between."""
    found = hashlib.sha256()
    async for piece in data:
        found.update(piece)
        yield piece
    if found.hexdigest() != digest:
        raise Problem("DIGEST_MISMATCH")


def upload_answer(taken: StoredUpload, prefix: str) -> JSONResponse:
    document = field_document(taken.record, prefix)
    headers = {"Location": document["links"]["self"], "ETag": field_etag(taken.record)}
    return JSONResponse(document, status_code=201 if taken.created else 200, headers=headers)

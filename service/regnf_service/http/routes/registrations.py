"""POST /register: one registration, by reference or with its files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query
from starlette.requests import Request
from starlette.responses import JSONResponse

from regnf_core.detections.images import ImageDetection
from regnf_core.field_source import Role
from regnf_core.importing.upload_description import UploadDescription
from regnf_service.concurrency import in_thread
from regnf_service.fields.ingest import Beside, room_for_bytes, store_upload
from regnf_service.fields.uploads import Received, SettingsUpload, Upload, settings_limit
from regnf_service.http import body
from regnf_service.http.batch_intake import Library, asked_by_reference, read_library
from regnf_service.http.body import (
    CallerDep,
    PrefixDep,
    ServicesDep,
    Sink,
    boundary_of,
    read_json,
    read_parts,
    read_text,
    wait_for,
)
from regnf_service.http.middleware import fair_key
from regnf_service.http.routes.documentation import (
    FILE,
    JOB_LINKS,
    JSON,
    MULTIPART_REFUSALS,
    UPLOAD_REFUSALS,
    header,
    refusals,
)
from regnf_service.http.routes.examples import REGISTER_EXAMPLES
from regnf_service.http.routes.jobs import job_answer
from regnf_service.http.routes.recordings import FRAME_PARTS, camera_of
from regnf_service.http.routes.uploads import DESCRIPTION_BYTES, read_description
from regnf_service.http.schemas.jobs import JobDocument
from regnf_service.http.schemas.reading import reference
from regnf_service.http.schemas.registrations import DryRunDocument, OneShotRequest, RegisterRequest
from regnf_service.jobs.submit import check_fields, check_idempotency_key, future_job_id, require_box, submit
from regnf_service.problem import Problem
from regnf_service.recordings.uploads import CAMERA_BYTES, AsRecording, FrameUpload
from regnf_service.services import Services
from regnf_state.records import ACTIVE, FINISHED
from regnf_state.registration_request import JobRequest, RegistrationRequest

# What the routes that start jobs have in common: how they are asked, and the answer with the job.

_PREFERENCE = re.compile(r"\s*wait\s*=\s*\"?(\d{1,6})\"?\s*", re.IGNORECASE)
_MAX_WAIT_S = 30
DryRunQuery = Annotated[bool, Query(description="Only check the request; start no job.")]
PreferHeader = Annotated[
    str | None, Header(description="`wait=N`: send the response when the job has finished, or after N seconds.")
]
IdempotencyKeyHeader = Annotated[
    str | None,
    Header(
        description="Up to 255 printable ASCII characters, kept for 24 hours. The same key with a different "
        "request is refused.",
        json_schema_extra={"pattern": "^[!-~]([ -~]{0,253}[!-~])?$"},
    ),
]
JOB_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The job has finished (with `Prefer: wait`, or the same request was posted earlier), or the "
        "dry run passed.",
        "content": {JSON: {"schema": {"anyOf": [reference(JobDocument), reference(DryRunDocument)]}}},
        "links": JOB_LINKS,
    },
    202: {
        "description": "Accepted.",
        "headers": {"Location": header("The job."), "Retry-After": header("Seconds to wait before the next request.")},
        "links": JOB_LINKS,
    },
}
JOB_REFUSALS = (
    "INVALID_QUERY INVALID_HEADER WEBHOOK_NOT_ALLOWED IDEMPOTENCY_KEY_REUSED QUEUE_FULL QUOTA_ACTIVE_JOBS "
    "QUOTA_WEBHOOKS"
)


@dataclass(frozen=True)
class Asking:
    """How a job is requested, beside what it is to do."""

    dry_run: bool
    prefer: str | None
    idempotency_key: str | None


def preferred_wait(prefer: str | None) -> int | None:
    """The seconds of `Prefer: wait=N` (RFC 7240), at most thirty; what is malformed is ignored, as the RFC has it."""
    for preference in (prefer or "").split(","):
        match = _PREFERENCE.fullmatch(preference)
        if match:
            return min(int(match.group(1)), _MAX_WAIT_S)
    return None


async def answer(services: Services, caller: str, prefix: str, asked: JobRequest, asking: Asking) -> JSONResponse:
    """The answer to a request that was checked: the job, or what a dry run tells."""
    if asking.dry_run:
        job_id = await in_thread(future_job_id, services, caller, asked)
        return JSONResponse({"valid": True, "id": job_id, "request": asked.values()})
    record = await in_thread(submit, services, caller, asked, asking.idempotency_key)
    wait = preferred_wait(asking.prefer)
    if wait and record.status in ACTIVE:
        record = await wait_for(
            lambda: services.records.get_job(record.id) or record,
            lambda found: found.status in FINISHED,
            wait,
            services,
            caller,
        )
    response = await job_answer(services, record, prefix, 200 if record.status in FINISHED else 202)
    response.headers["Location"] = f"{prefix}/jobs/{record.id}"
    if wait is not None:
        response.headers["Preference-Applied"] = f"wait={wait}"
    return response


router = APIRouter(tags=["registrations"])
_PNG = b"\x89PNG"
_ROLES: tuple[Role, Role] = ("scene", "object")
_ONE_SHOT = {
    "schema": {
        "type": "object",
        "required": ["request"],
        "additionalProperties": False,
        "properties": {
            "scene": FILE,
            "object": FILE,
            **FRAME_PARTS,
            "mask": FILE | {"description": "The mask of the object in the frame: a PNG of the same size."},
            "request": reference(OneShotRequest),
            **{f"{role}_description": reference(UploadDescription) for role in ("scene", "object")},
            **{f"{role}_settings": FILE for role in ("scene", "object")},
        },
    }
}


@router.post(
    "/register",
    summary="Register an object: find its pose in the scene",
    response_model=JobDocument,
    status_code=202,
    responses={
        **JOB_RESPONSES,
        **refusals(
            UPLOAD_REFUSALS,
            MULTIPART_REFUSALS,
            JOB_REFUSALS,
            "MALFORMED_JSON FIELD_NOT_FOUND INVALID_REQUEST INVALID_DETECTION INVALID_OPTIONS OPTIONS_TOO_COSTLY "
            "INVALID_TRANSFORM PRESET_UNSUITABLE LIBRARY_ENTRY_NOT_FOUND LIBRARY_EMPTY LIBRARY_TOO_LARGE "
            "FIELD_REJECTED FIELD_DESCRIPTION_DIFFERS INVALID_DESCRIPTION DETECTION_OUTSIDE_SCENE "
            "RECORDING_NOT_RECOGNIZED RECORDING_UNSUITABLE IMAGE_DETECTION_WITHOUT_RECORDING",
        ),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                JSON: {"schema": reference(RegisterRequest), "examples": REGISTER_EXAMPLES},
                "multipart/form-data": _ONE_SHOT,
            },
        }
    },
)
async def register(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    dry_run: DryRunQuery = False,
    prefer: PreferHeader = None,
    idempotency_key: IdempotencyKeyHeader = None,
) -> JSONResponse:
    """The same request twice is one job: the job id is a hash of the request. A job that failed is started again.

    Requests that differ only in the label, the score or the webhook are the same. Every webhook gets the message about
    the end of the job.
    """
    check_idempotency_key(idempotency_key)
    asked = await _read(request, services, caller, keep=not dry_run)
    return await answer(services, caller, prefix, asked, Asking(dry_run, prefer, idempotency_key))


async def _read(request: Request, services: Services, caller: str, keep: bool) -> RegistrationRequest:
    """What is requested, checked; files that come along are kept if ``keep``."""
    match body.media_type(request):
        case "application/json":
            return await _by_reference(request, services, caller)
        case "multipart/form-data":
            return await _one_shot(request, services, caller, keep)
    raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/json or multipart/form-data.")


async def _by_reference(request: Request, services: Services, caller: str) -> RegistrationRequest:
    spec = await read_json(request, services, caller, RegisterRequest)
    library = Library(services, caller)
    await read_library(library, [spec])
    asked, named = await in_thread(asked_by_reference, library, spec)
    await in_thread(check_fields, services, caller, asked, named)
    return asked


async def _one_shot(request: Request, services: Services, caller: str, keep: bool) -> RegistrationRequest:
    """All in one body: the scene's file or a frame, the object's file unless the request names one that is held.

    Nothing is kept before all of it has arrived and been checked.
    """
    body.refuse_encoding(request)
    settings = services.settings
    besides = 3 * settings.max_request_bytes + 4 * DESCRIPTION_BYTES + CAMERA_BYTES
    limit = 2 * (settings.max_upload_bytes + settings_limit(services)) + besides
    declared = body.declared_length(request, besides)
    async with AsyncExitStack() as stack:
        stack.enter_context(services.uploads.held(fair_key(request.scope, caller), count=2))
        room = await in_thread(room_for_bytes, services, caller)
        claim = stack.enter_context(services.under_way.claim(caller, room, declared))
        files = {name: await stack.enter_async_context(Upload(services, claim)) for name in _ROLES}
        configs = {name: await stack.enter_async_context(SettingsUpload(services, claim)) for name in _ROLES}
        frame = await stack.enter_async_context(FrameUpload(services, claim))
        sinks: dict[str, Sink] = {**frame.images}
        for name in _ROLES:
            sinks |= {name: files[name], f"{name}_settings": configs[name]}
        texts = {"request": settings.max_request_bytes, "camera": CAMERA_BYTES, "mask": settings.max_request_bytes}
        texts |= {f"{name}_description": DESCRIPTION_BYTES for name in _ROLES}
        parts = await read_parts(body.chunks(request, limit), boundary_of(request), sinks, texts)
        _check_parts(parts)
        spec = await read_text(OneShotRequest, parts["request"], what="The part `request`")
        uploads: dict[str, tuple[Upload, Received, Beside]] = {}
        for name in (name for name in _ROLES if name in parts):
            said = read_description(parts.get(f"{name}_description"))
            beside = Beside(said, await configs[name].received(), role=name)
            uploads[name] = (files[name], await files[name].finish(), beside)
        if "depth" in parts:
            received = await frame.finish_frame({"camera.json": camera_of(parts)})
            uploads["scene"] = (frame, received, AsRecording())
        asked, named = await _asked(
            services, caller, spec, {name: one[1].sha256 for name, one in uploads.items()}, parts
        )
        if "scene" in parts:
            require_box(asked)
        await in_thread(check_fields, services, caller, asked, named)  # what comes along need not be held
        for upload, received, beside in uploads.values() if keep else ():
            await store_upload(services, caller, upload, received, beside)
    return asked


def _check_parts(parts: Mapping[str, bytes]) -> None:
    """Raises Problem MALFORMED_MULTIPART."""
    if "request" not in parts:
        raise Problem(
            "MALFORMED_MULTIPART", "The part `request` is missing. It is needed unless the part `object` is sent."
        )
    if ("scene" in parts) == ("depth" in parts):
        raise Problem("MALFORMED_MULTIPART", "Send the part `scene`, or the parts `depth` and `camera` of a frame.")
    needed = {"camera": "depth", "depth": "camera", "color": "depth", "mask": "depth"}
    needed |= {f"{name}_{what}": name for name in _ROLES for what in ("settings", "description")}
    for part, other in needed.items():
        if part in parts and other not in parts:
            raise Problem("MALFORMED_MULTIPART", f"The part `{part}` needs the part `{other}`, which is missing.")


async def _asked(
    services: Services, caller: str, spec: OneShotRequest, came: Mapping[str, str], parts: Mapping[str, bytes]
) -> tuple[RegistrationRequest, dict[str, str]]:
    """The job's request and the fields that must be held, as ``asked_by_reference``. came: the SHA-256s of files."""
    if ("object" in came) == (spec.object is not None or spec.candidates is not None):
        raise Problem("MALFORMED_MULTIPART", "Send the part `object`, or give `object` or `candidates` in the request.")
    if ("mask" in parts) == (spec.detection is not None) or not parts.get("mask", _PNG).startswith(_PNG):
        raise Problem("INVALID_DETECTION", "Give `detection` in the request, or a PNG as the part `mask` of a frame.")
    mask = (ImageDetection(mask=base64.b64encode(parts["mask"]).decode()),) if "mask" in parts else spec.detection
    whole = spec.model_copy(update={**came, "detection": mask})
    library = Library(services, caller)
    await read_library(library, [whole])
    asked, named = await in_thread(asked_by_reference, library, whole)
    return asked, {pointer: name for pointer, name in named.items() if pointer.strip("/") not in came}

"""POST /register: one registration, by reference or with its files."""

from __future__ import annotations

from contextlib import AsyncExitStack

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import JSONResponse

from regnf_core.field_source import Role
from regnf_core.importing.upload_description import UploadDescription
from regnf_service.concurrency import in_thread
from regnf_service.fields.ingest import Beside, room_for_bytes, store_upload
from regnf_service.fields.uploads import open_settings, open_upload, settings_limit
from regnf_service.http import body
from regnf_service.http.by_reference import Library, asked_by_reference, read_library
from regnf_service.http.dependencies import CallerDep, PrefixDep, ServicesDep
from regnf_service.http.multipart import boundary_of, read_parts
from regnf_service.http.pace import Pace
from regnf_service.http.parsing import read_json, read_text
from regnf_service.http.routes.documentation import (
    FILE,
    JSON,
    MULTIPART_REFUSALS,
    UPLOAD_REFUSALS,
    refusals,
)
from regnf_service.http.routes.examples import REGISTER_EXAMPLES
from regnf_service.http.routes.submitting import (
    JOB_REFUSALS,
    JOB_RESPONSES,
    Asking,
    DryRunQuery,
    IdempotencyKeyHeader,
    PreferHeader,
    answer,
)
from regnf_service.http.routes.uploads import DESCRIPTION_BYTES, read_description
from regnf_service.http.schemas.jobs import JobDocument
from regnf_service.http.schemas.references import reference
from regnf_service.http.schemas.registrations import RegisterRequest, RegistrationSpec
from regnf_service.http.turns import fair_key
from regnf_service.jobs.submit import check_fields, check_idempotency_key
from regnf_service.problem import CLOSE, Problem
from regnf_service.services import Services
from regnf_state.registration_request import RegistrationRequest

router = APIRouter(tags=["registrations"])
_ROLES: tuple[Role, Role] = ("scene", "object")
_ONE_SHOT = {
    "schema": {
        "type": "object",
        "required": ["scene", "object", "request"],
        "additionalProperties": False,
        "properties": {
            "scene": FILE,
            "object": FILE,
            "request": reference(RegistrationSpec),
            **{f"{role}_description": reference(UploadDescription) for role in ("scene", "object")},
            **{f"{role}_settings": FILE for role in ("scene", "object")},
        },
    }
}


@router.post(
    "/register",
    summary="Find the transform that lays the scene's copy of the object onto the library's",
    response_model=JobDocument,
    status_code=202,
    responses={
        **JOB_RESPONSES,
        **refusals(
            *UPLOAD_REFUSALS,
            *MULTIPART_REFUSALS,
            *JOB_REFUSALS,
            "MALFORMED_JSON",
            "FIELD_NOT_FOUND",
            "INVALID_REQUEST",
            "INVALID_DETECTION",
            "INVALID_OPTIONS",
            "OPTIONS_TOO_COSTLY",
            "INVALID_TRANSFORM",
            "INITIAL_TRANSFORM_UNSUPPORTED",
            "LIBRARY_SEARCH_UNSUPPORTED",
            "LIBRARY_ENTRY_NOT_FOUND",
            "LIBRARY_EMPTY",
            "LIBRARY_TOO_LARGE",
            "FIELD_REJECTED",
            "FIELD_DESCRIPTION_DIFFERS",
            "INVALID_DESCRIPTION",
            "DETECTION_OUTSIDE_SCENE",
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
    """The same request twice is one job: its id follows from what is asked. A job that failed is started anew.

    Requests that differ in the label, the score or the webhook alone are the same. Every webhook is told of the end.
    """
    check_idempotency_key(idempotency_key)
    asked = await _read(request, services, caller, keep=not dry_run)
    return await answer(services, caller, prefix, asked, Asking(dry_run, prefer, idempotency_key))


async def _read(request: Request, services: Services, caller: str, keep: bool) -> RegistrationRequest:
    """What is asked for, checked; files that come along are kept if ``keep``."""
    match body.media_type(request):
        case "application/json":
            return await _by_reference(request, services, caller)
        case "multipart/form-data":
            return await _one_shot(request, services, caller, keep)
    raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/json or multipart/form-data.", headers=CLOSE)


async def _by_reference(request: Request, services: Services, caller: str) -> RegistrationRequest:
    spec = await read_json(request, services, caller, RegisterRequest)
    library = Library(services, caller)
    await read_library(library, [spec])
    asked, named = await in_thread(asked_by_reference, library, spec)
    await in_thread(check_fields, services, caller, asked, named)
    return asked


async def _one_shot(request: Request, services: Services, caller: str, keep: bool) -> RegistrationRequest:
    """Both files and the request in one body. Nothing is kept before all of it has arrived and been checked."""
    body.refuse_encoding(request)
    settings = services.settings
    besides = 2 * settings.max_request_bytes + 4 * DESCRIPTION_BYTES
    limit = 2 * (settings.max_upload_bytes + settings_limit(services)) + besides
    declared = body.declared_length(request, besides)
    pace = Pace(settings)
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(services.uploads.held(fair_key(request.scope, caller), pace, count=2))
        room = await in_thread(room_for_bytes, services, caller)
        claim = stack.enter_context(services.under_way.claim(caller, room, declared))
        files = {name: await stack.enter_async_context(open_upload(services, claim)) for name in _ROLES}
        configs = {name: await stack.enter_async_context(open_settings(services, claim)) for name in _ROLES}
        sinks = files | {f"{name}_settings": config for name, config in configs.items()}
        texts = {"request": settings.max_request_bytes} | {f"{name}_description": DESCRIPTION_BYTES for name in _ROLES}
        data = body.chunks(request, limit, pace)
        parts = await read_parts(data, boundary_of(request), sinks, texts)
        missing = [name for name in ("scene", "object", "request") if name not in parts]
        if missing:
            raise Problem("MISSING_PART", f"The part `{missing[0]}` is missing.")
        spec = await read_text(RegistrationSpec, parts["request"], what="The part `request`")
        said = {name: read_description(parts.get(f"{name}_description")) for name in _ROLES}
        received = {name: await upload.finish() for name, upload in files.items()}
        beside = {name: Beside(said[name], await configs[name].received(), role=name) for name in _ROLES}
        asked = spec.to_request(received["scene"].sha256, received["object"].sha256)
        await in_thread(check_fields, services, caller, asked, {})  # they are taken in next, so none need be held
        if keep:
            for name, upload in files.items():
                await store_upload(services, caller, upload, received[name], beside[name])
    return asked

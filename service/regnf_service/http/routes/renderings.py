"""POST /render: pictures, a mesh and a field of a scene with edits."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from starlette.requests import Request
from starlette.responses import JSONResponse

from regnf_core.errors import InvalidInputError
from regnf_core.rendering.camera_poses import poses_of_transforms
from regnf_core.rendering.request import RenderRequest
from regnf_service.concurrency import in_thread
from regnf_service.http import body
from regnf_service.http.body import CallerDep, PrefixDep, ServicesDep, read_json
from regnf_service.http.routes.documentation import JSON, refusals
from regnf_service.http.routes.examples import RENDER_EXAMPLES
from regnf_service.http.routes.registrations import (
    JOB_REFUSALS,
    JOB_RESPONSES,
    Asking,
    DryRunQuery,
    IdempotencyKeyHeader,
    PreferHeader,
    answer,
)
from regnf_service.http.schemas.jobs import JobDocument
from regnf_service.http.schemas.reading import reference
from regnf_service.http.schemas.registrations import rows_of
from regnf_service.http.schemas.scenes import MOST_CAMERAS, RenderBody
from regnf_service.http.strict_json import MOST_VALUES_WITH_CAMERAS
from regnf_service.jobs.edits import plain_edits
from regnf_service.jobs.submit import check_fields, check_idempotency_key
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.registration_request import RenderingRequest, objects_of

router = APIRouter(tags=["renderings"])


@router.post(
    "/render",
    summary="Render a scene with edits: objects substituted, replaced, removed or inserted",
    response_model=JobDocument,
    status_code=202,
    responses={
        **JOB_RESPONSES,
        **refusals(
            JOB_REFUSALS,
            "MALFORMED_JSON INVALID_HEADER REQUEST_TOO_LARGE UNSUPPORTED_MEDIA_TYPE TOO_MANY_REQUESTS_AT_ONCE "
            "UPLOAD_INCOMPLETE INVALID_REQUEST INVALID_OPTIONS INVALID_TRANSFORM INVALID_DETECTION "
            "DETECTION_OUTSIDE_SCENE EDIT_INVALID CAMERA_INVALID RENDER_TOO_LARGE FIELD_NOT_FOUND FIELD_REJECTED "
            "JOB_NOT_FOUND JOB_EXPIRED JOB_NOT_READY JOB_DISMISSED JOB_FAILED",
        ),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {JSON: {"schema": reference(RenderBody), "examples": RENDER_EXAMPLES}},
        }
    },
)
async def render(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    dry_run: DryRunQuery = False,
    prefer: PreferHeader = None,
    idempotency_key: IdempotencyKeyHeader = None,
) -> JSONResponse:
    """The rendering is a job, like a registration: the same request twice is one job. If an edit names a registration,
    that registration must be finished."""
    check_idempotency_key(idempotency_key)
    if body.media_type(request) != JSON:
        raise Problem("UNSUPPORTED_MEDIA_TYPE", "Send application/json.")
    said = await read_json(request, services, caller, RenderBody, MOST_VALUES_WITH_CAMERAS)
    asked = await in_thread(_checked, services, caller, said)
    return await answer(services, caller, prefix, asked, Asking(dry_run, prefer, idempotency_key))


def _checked(services: Services, caller: str, said: RenderBody) -> RenderingRequest:
    edits = plain_edits(services, caller, said.scene, [one.plain() for one in said.edits])
    try:
        rendering = said.rendering(edits, _poses(said))
    except InvalidInputError as error:
        raise Problem(error.reason, str(error), hint=error.hint) from error
    asked = RenderingRequest(said.scene, rendering, None if said.webhook is None else said.webhook.url)
    check_fields(services, caller, asked, {"/scene": said.scene} | _named(rendering))
    return asked


def _poses(said: RenderBody) -> list[dict[str, Any]] | None:
    file = said.transforms
    if file is None:
        return None
    T = None if file.T_scene_file is None else rows_of(file.T_scene_file)
    poses = poses_of_transforms(file.document, T, said.size, file.every)
    if len(poses) > MOST_CAMERAS:
        message = f"{len(poses)} cameras; at most {MOST_CAMERAS} of a file can be used"
        raise InvalidInputError(message, reason="RENDER_TOO_LARGE", hint="Use every N-th camera: `transforms.every`.")
    return poses


def _named(rendering: RenderRequest) -> dict[str, str]:
    """The fields that edits name, by where; those of a job by the place that names the job's object."""
    return {
        f"/edits/{number}/{member}": sha256
        for number, edit in enumerate(rendering.edits)
        for member, sha256 in objects_of(edit).items()
    }

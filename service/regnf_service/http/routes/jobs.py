"""Jobs: their documents, their events, and their end."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, NamedTuple

from fastapi import APIRouter, Header, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from regnf_service.concurrency import blocking, in_thread
from regnf_service.http import sse
from regnf_service.http.body import CallerDep, LimitQuery, PageTokenQuery, PrefixDep, ServicesDep, WaitQuery, wait_for
from regnf_service.http.query import decode_token, encode_token, wants_page
from regnf_service.http.ranges import IfNoneMatchDep
from regnf_service.http.routes.documentation import NOT_MODIFIED, header, refusals
from regnf_service.http.routes.pages import HTML, page
from regnf_service.http.schemas.jobs import JobDocument, JobPage, Status, job_document, request_document
from regnf_service.jobs.edits import find_job
from regnf_service.jobs.submit import digest
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.queue import Work
from regnf_state.records import ACTIVE, JobRecord
from regnf_state.redis.webhook_outbox import Delivery

router = APIRouter(tags=["jobs"])
_RETRY_AFTER_S = "1"
_EVENT_ID = {"pattern": "^[0-9]{1,19}(-[0-9]{1,19})?$"}
_REQUEST = {"$ref": "#/components/schemas/RegisterRequest"}
_EVENT = {
    "description": "One event of the stream.",
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string"} | _EVENT_ID,
        "event": {"enum": ["status", "progress"]},
        "data": {"type": "string", "contentMediaType": "application/json"},
    },
}


async def job_answer(services: Services, record: JobRecord, prefix: str, status: int = 200) -> JSONResponse:
    """The job's document, with the headers that tell a poller when to come back."""
    return _answer(services, await in_thread(_seen, services, record), prefix, status)


class _Seen(NamedTuple):
    """A job with what its document shows beside the record."""

    record: JobRecord
    position: int | None
    deliveries: list[Delivery]


def _seen(services: Services, record: JobRecord) -> _Seen:
    work = Work("registration", record.id, record.attempt)
    position = services.queue.position(work) if record.status == "accepted" else None
    return _Seen(record, position, services.webhooks.deliveries(record))


def _answer(services: Services, seen: _Seen, prefix: str, status: int) -> JSONResponse:
    record, position, deliveries = seen
    headers = {"ETag": _etag(seen), "Cache-Control": "no-cache"}
    if record.status in ACTIVE:
        headers["Retry-After"] = _RETRY_AFTER_S
    document = job_document(record, position, services.settings.job_retention_s, prefix, deliveries)
    return JSONResponse(document, status_code=status, headers=headers)


def _etag(seen: _Seen) -> str:
    # by what the document shows, not by the version: heartbeats change that every few seconds
    record, position, deliveries = seen
    shown: list[Any] = [record.attempt, record.status, record.phase, record.progress, record.updated, position]
    shown += map(asdict, deliveries)
    return f'"{digest(shown)[:24]}"'


@router.get(
    "/jobs",
    summary="Jobs, newest first",
    response_model=JobPage,
    responses={200: {"content": HTML}, **refusals("INVALID_QUERY")},
)
@blocking
def list_jobs(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
    status: Annotated[Status | None, Query(description="Only jobs with this status.")] = None,
) -> Response:
    """A page may be short or empty although more pages follow. Continue while there is a `next_page_token`.

    `queue_position` is null here: get the job itself for it. A browser gets a page, which needs no token.
    """
    if wants_page(request.scope):
        return page("lists.html")
    found = services.records.list_jobs(status, limit, decode_token(page_token), caller)
    documents = [job_document(record, None, services.settings.job_retention_s, prefix) for record in found.records]
    document = {"jobs": documents, "next_page_token": encode_token(found.rest)}
    return JSONResponse(document, headers={"Vary": "Accept"})


@router.get(
    "/jobs/{id}",
    summary="A job's state",
    response_model=JobDocument,
    responses={
        200: {
            "headers": {
                "ETag": header("For If-None-Match."),
                "Retry-After": header("Seconds to wait before the next request. Only while the job is active."),
            }
        },
        304: NOT_MODIFIED,
        **refusals("INVALID_QUERY", "JOB_NOT_FOUND", "JOB_EXPIRED"),
    },
)
async def get_job(
    id: str,  # noqa: A002 -- the contract's own word
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    held: IfNoneMatchDep,
    wait: WaitQuery = 0,
) -> Response:
    """With `wait`, the response is sent when the job has finished. With `If-None-Match` too, it is sent at the first
    change."""

    def look() -> _Seen:
        record = find_job(services, id, caller)
        if wait and not held.given:
            return _Seen(record, None, [])  # its state is all that is waited for
        return _seen(services, record)

    def is_news(seen: _Seen) -> bool:
        return seen.record.status not in ACTIVE or held.differs(_etag(seen))

    seen = await wait_for(look, is_news, wait, services, caller)
    if wait and not held.given:
        seen = await in_thread(_seen, services, seen.record)
    return held.apply(_answer(services, seen, prefix, 200))


@router.get(
    "/jobs/{id}/request",
    summary="The request of a registration",
    responses={
        200: {"content": {"application/json": {"schema": _REQUEST}}},
        **refusals("JOB_NOT_FOUND", "JOB_EXPIRED"),
    },
)
@blocking
def get_request(id: str, services: ServicesDep, caller: CallerDep) -> Response:  # noqa: A002
    """The body of `POST /register` without the webhook. It can be posted again, unchanged or with other options."""
    record = find_job(services, id, caller)
    accepted = services.records.journal.accepted(record.id)
    if record.kind != "registration" or accepted is None:
        raise Problem("JOB_NOT_FOUND", "The request of this job is not kept, or the job is a rendering.")
    return JSONResponse(request_document(accepted.request), headers={"Cache-Control": "no-cache"})


@router.get(
    "/jobs/{id}/events",
    summary="A job's changes as server-sent events",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Events `status` and `progress`; the data are status, phase, progress, attempt and "
            "updated. The stream ends with the last event of the job.",
            "content": {sse.MEDIA_TYPE: {"schema": _EVENT}},
        },
        204: {"description": "The job has finished and `Last-Event-ID` was its last event: do not reconnect."},
        **refusals("INVALID_HEADER", "JOB_NOT_FOUND", "JOB_EXPIRED", "TOO_MANY_REQUESTS_AT_ONCE"),
    },
)
async def job_events(
    id: str,  # noqa: A002
    services: ServicesDep,
    caller: CallerDep,
    last_event_id: Annotated[
        str | None, Header(description="Resume after this event.", json_schema_extra=_EVENT_ID)
    ] = None,
) -> Response:
    """The stream starts at the first event, or after `Last-Event-ID`."""
    record = await in_thread(find_job, services, id, caller)
    try:
        waiting = await in_thread(services.records.events, id, last_event_id)
    except ValueError as error:
        raise Problem("INVALID_HEADER", "`Last-Event-ID` is not the id of an event of this service.") from error
    if last_event_id is not None and record.status not in ACTIVE and not waiting:
        return Response(status_code=204)
    return sse.EventStream(services.streams, caller, sse.event_stream(services, id, last_event_id))


@router.post(
    "/jobs/{id}/cancel",
    summary="Cancel a job",
    response_model=JobDocument,
    status_code=202,
    responses={
        200: {"description": "The job was dismissed already.", "model": JobDocument},
        202: {"description": "A waiting job is dismissed immediately, a running job within seconds."},
        **refusals("JOB_NOT_FOUND", "JOB_FINISHED", "JOB_EXPIRED"),
    },
)
async def cancel_job(
    id: str,  # noqa: A002
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
) -> JSONResponse:
    """A second call is no error."""
    before = await in_thread(find_job, services, id, caller)
    if before.status == "dismissed":
        return await job_answer(services, before, prefix)
    after = await in_thread(services.records.request_cancel, id)
    if after is None:
        raise Problem("JOB_NOT_FOUND")
    if after.status in ("successful", "failed"):
        raise Problem("JOB_FINISHED")
    await in_thread(services.queue.stop, id, after.attempt)
    return await job_answer(services, after, prefix, 202)


@router.delete(
    "/jobs/{id}",
    summary="Delete a job and its artifacts",
    status_code=204,
    response_class=Response,
    responses=refusals("JOB_NOT_FOUND", "JOB_ACTIVE", "JOB_EXPIRED"),
)
@blocking
def delete_job(id: str, services: ServicesDep, caller: CallerDep) -> Response:  # noqa: A002
    """Only a finished job can be deleted. Cancel a running job first."""
    if find_job(services, id, caller).status in ACTIVE:
        raise Problem("JOB_ACTIVE")
    services.records.delete_job(id)
    services.blobs.delete_prefix(f"jobs/{id}")
    return Response(status_code=204)

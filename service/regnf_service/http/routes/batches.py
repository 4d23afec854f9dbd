"""Batches: many registrations in one body, and their results in its order."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from regnf_service.batches import Posting, cancel, find_batch, is_waiting, results_page, state_of
from regnf_service.concurrency import PARSING, blocking, in_thread, portions
from regnf_service.http import body
from regnf_service.http.batch_intake import Intake, lines_of, read_library
from regnf_service.http.body import (
    CallerDep,
    LimitQuery,
    PageTokenQuery,
    PrefixDep,
    ServicesDep,
    WaitQuery,
    wait_for,
)
from regnf_service.http.middleware import fair_key
from regnf_service.http.query import decode_token, encode_token
from regnf_service.http.routes.documentation import BATCH_LINKS, BINARY, FILE, header, refusals
from regnf_service.http.schemas.batches import BatchDocument, BatchPage, BatchPair, BatchResult, ResultStatus
from regnf_service.http.schemas.batches import batch_document as document_of
from regnf_service.http.schemas.batches import summary_document as summary_of
from regnf_service.http.schemas.reading import reference
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.batches import Batch

router = APIRouter(tags=["batches"])
MEDIA_TYPE = "application/x-ndjson"
_MOST_LINES = 2**31 - 1
"""More than any batch has; what a query may ask for at most."""
_LINES_AT_ONCE = 50
_BYTES_AT_ONCE = 64 * 1024
_BODY = {"schema": FILE, "x-line-schema": reference(BatchPair)}


@router.post(
    "/batches",
    summary="Register many pairs",
    response_model=BatchDocument,
    status_code=202,
    responses={
        200: {"description": "All jobs of the batch have ended.", "links": BATCH_LINKS},
        202: {
            "description": "Jobs of the batch are waiting or running.",
            "headers": {"Location": header("The batch.")},
            "links": BATCH_LINKS,
        },
        **refusals(
            "INVALID_QUERY INVALID_HEADER UNSUPPORTED_MEDIA_TYPE MALFORMED_JSON REQUEST_TOO_LARGE UPLOAD_INCOMPLETE "
            "TOO_MANY_REQUESTS_AT_ONCE QUOTA_ACTIVE_JOBS QUOTA_STORED QUEUE_FULL STORAGE_FULL"
        ),
    },
    openapi_extra={"requestBody": {"required": True, "content": {MEDIA_TYPE: _BODY}}},
)
async def post_batch(request: Request, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> JSONResponse:
    """JSON Lines: each line is a body of `POST /register`, with an optional `key` of your own.

    Each line becomes a job, as with `POST /register`. An invalid line is listed in `errors` and does not affect the
    other lines. If the new jobs exceed your quota or the queue, no job is started: `new_jobs` has their number, and
    `fitting_lines` the number of first lines that would fit. The same lines are the same batch. If they are posted
    again, jobs that failed or were canceled are started again, and no other work is repeated.
    """
    if body.media_type(request) != MEDIA_TYPE:
        raise Problem("UNSUPPORTED_MEDIA_TYPE", f"Send JSON Lines as {MEDIA_TYPE}.")
    body.refuse_encoding(request)
    with services.uploads.held(fair_key(request.scope, caller)):
        posting = await _read(request, services, Intake(services, caller))
        for lines in posting.portions():
            await in_thread(posting.check, lines)
        await in_thread(posting.require_room)
        for lines in posting.portions():
            await in_thread(posting.submit, lines)
        batch = await in_thread(posting.keep)
    answer = await in_thread(_answer, services, batch, prefix, 202)
    answer.headers["Location"] = f"{prefix}/batches/{batch.id}"
    return answer


async def _read(request: Request, services: Services, intake: Intake) -> Posting:
    """The lines as they arrive, a few at a time beside the event loop."""
    chunks = body.chunks(request, services.settings.max_batch_bytes, "REQUEST_TOO_LARGE")
    async for lines in lines_of(chunks):
        for few in portions(lines, lambda line: len(line.text or b""), _BYTES_AT_ONCE, _LINES_AT_ONCE):
            read = await PARSING.run(intake.read, few)
            await read_library(intake.library, [spec for _, _, spec in read if spec is not None])
            await in_thread(intake.take, read)
    return intake.finish()


def _answer(services: Services, batch: Batch, prefix: str, status: int = 200) -> JSONResponse:
    """The batch; 200 in place of ``status`` where none of its jobs waits or runs."""
    document = document_of(batch, state_of(services, batch), services.settings.job_retention_s, prefix)
    status = status if document["status"] == "running" else 200
    return JSONResponse(document, status_code=status, headers={"Cache-Control": "no-cache"})


@router.get(
    "/batches",
    summary="Batches, newest first",
    response_model=BatchPage,
    responses=refusals("INVALID_QUERY"),
)
@blocking
def list_batches(
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
) -> Response:
    """A page may be short although more pages follow. Continue while there is a `next_page_token`."""
    page = services.batches.page(caller, limit, decode_token(page_token))
    documents = [summary_of(one, services.settings.job_retention_s, prefix) for one in page.records]
    return JSONResponse({"batches": documents, "next_page_token": encode_token(page.rest)})


@router.get(
    "/batches/{id}",
    summary="A batch's state",
    response_model=BatchDocument,
    responses=refusals("INVALID_QUERY", "BATCH_NOT_FOUND"),
)
async def get_batch(
    id: str,  # noqa: A002 -- the contract's own word
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    wait: WaitQuery = 0,
) -> Response:
    """With `wait`, the response is sent when all jobs of the batch have ended."""
    batch = await in_thread(find_batch, services, caller, id)
    if wait:
        look = services.records.active_among
        await wait_for(lambda: look(batch.jobs), lambda active: not active, wait, services, caller)
    return await in_thread(_answer, services, batch, prefix)


@router.get(
    "/batches/{id}/results",
    summary="The results of a batch that are available",
    response_class=Response,
    responses={
        200: {
            "description": "JSON Lines in the order of the pairs, up to the first pair that has not ended.",
            "content": {MEDIA_TYPE: {**BINARY, "x-line-schema": reference(BatchResult)}},
            "headers": {
                "Batch-After": header("The value of `after` for the next call."),
                "Batch-Left": header("Number of pairs after this page; 0 on the last page."),
            },
        },
        **refusals("INVALID_QUERY", "BATCH_NOT_FOUND"),
    },
)
async def batch_results(
    id: str,  # noqa: A002
    services: ServicesDep,
    caller: CallerDep,
    after: Annotated[
        int, Query(ge=0, le=_MOST_LINES, description="The `number` of the last result that you have.")
    ] = 0,
    limit: Annotated[
        int, Query(ge=1, le=_MOST_LINES, description="Largest number of lines in the response.")
    ] = _MOST_LINES,
    status: Annotated[ResultStatus | None, Query(description="Only pairs with this outcome.")] = None,
    wait: WaitQuery = 0,
) -> Response:
    """One line per result. A page has at most some hundreds of lines, or 1 MiB. Get the next page with `Batch-After`
    until `Batch-Left` is 0.

    With `wait`, the response is sent when the pair after `after` has ended.
    """
    batch = await in_thread(find_batch, services, caller, id)
    if wait:
        await wait_for(lambda: is_waiting(services, batch, after), lambda waits: not waits, wait, services, caller)
    page = await in_thread(results_page, services, batch, after, limit, status)
    left = max(0, len(batch.pairs) - page.after)
    headers = {"Batch-After": str(page.after), "Batch-Left": str(left), "Cache-Control": "no-cache"}
    return Response(page.text, media_type=MEDIA_TYPE, headers=headers)


@router.post(
    "/batches/{id}/cancel",
    summary="Cancel a batch",
    response_model=BatchDocument,
    status_code=202,
    responses={
        200: {"description": "All jobs of the batch have ended.", "model": BatchDocument},
        **refusals("BATCH_NOT_FOUND"),
    },
)
@blocking
def cancel_batch(id: str, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> JSONResponse:  # noqa: A002
    """Cancels all jobs that the batch started and that have not ended. Waiting jobs end at once, running jobs within
    seconds. Jobs that another request started continue. Results are kept."""
    batch = find_batch(services, caller, id)
    cancelled = cancel(services, batch)
    answer = _answer(services, batch, prefix)
    answer.status_code = 202 if cancelled else 200
    return answer


@router.delete(
    "/batches/{id}",
    summary="Delete a batch",
    status_code=204,
    response_class=Response,
    responses=refusals("BATCH_NOT_FOUND"),
)
@blocking
def delete_batch(id: str, services: ServicesDep, caller: CallerDep) -> Response:  # noqa: A002
    """The jobs of the batch are kept and continue. Cancel the batch first to stop them."""
    services.batches.delete(caller, find_batch(services, caller, id).id)
    return Response(status_code=204)

"""Batches: thousands of registrations in one body, and their results as they come."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from itertools import islice
from typing import Annotated

from fastapi import APIRouter, Query
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from regnf_service.batches.cancelling import cancel, go_on
from regnf_service.batches.lookup import Found, find_batch
from regnf_service.concurrency import PARSING, blocking, in_thread
from regnf_service.http import body
from regnf_service.http.batch_intake import Intake
from regnf_service.http.batch_lines import lines_of
from regnf_service.http.dependencies import CallerDep, LimitQuery, PageTokenQuery, PrefixDep, ServicesDep, WaitQuery
from regnf_service.http.pace import Pace
from regnf_service.http.paging import decode_token, encode_token
from regnf_service.http.routes.documentation import BATCH_LINKS, BINARY, FILE, header, refusals
from regnf_service.http.schemas.batches import BatchDocument, BatchPage, BatchPair, BatchResult, ResultStatus
from regnf_service.http.schemas.batches import batch_document as document_of
from regnf_service.http.schemas.references import reference
from regnf_service.http.turns import fair_key
from regnf_service.http.waiting import wait_for
from regnf_service.problem import CLOSE, RETRY_LATER, Problem
from regnf_service.services import Services
from regnf_state.batch_records import Batch
from regnf_state.blobs.base import BlobWriter

router = APIRouter(tags=["batches"])
MEDIA_TYPE = "application/x-ndjson"
_LINES_AT_ONCE = 50
_MOST_LINES = 2**31 - 1
"""More than any batch has; what a query may ask for at most."""
_BODY = {"schema": FILE, "x-line-schema": reference(BatchPair)}


@router.post(
    "/batches",
    summary="Register many pairs",
    response_model=BatchDocument,
    status_code=202,
    responses={
        200: {"description": "The batch has ended, and none of its pairs has failed.", "links": BATCH_LINKS},
        202: {
            "description": "The batch goes on.",
            "headers": {"Location": header("The batch.")},
            "links": BATCH_LINKS,
        },
        **refusals(
            "INVALID_QUERY",
            "INVALID_HEADER",
            "UNSUPPORTED_MEDIA_TYPE",
            "REQUEST_TOO_LARGE",
            "TOO_MANY_PAIRS",
            "BATCH_EMPTY",
            "UPLOAD_INCOMPLETE",
            "UPLOAD_STALLED",
            "TOO_MANY_UPLOADS",
            "QUOTA_BATCHES",
            "CONFLICT",
            "STORAGE_FULL",
        ),
    },
    openapi_extra={"requestBody": {"required": True, "content": {MEDIA_TYPE: _BODY}}},
)
async def post_batch(request: Request, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> JSONResponse:
    """JSON Lines: on each line what `POST /register` takes, with a `key` of your own if you like.

    A line that is no request becomes a result with an error, and refuses no other. The same lines are the same batch:
    posted again, one that was cancelled goes on, and one that has ended does its failed pairs again. Equal pairs are
    one job. A few pairs at a time are handed to the queue, so that nobody waits for the whole batch.
    """
    if body.media_type(request) != MEDIA_TYPE:
        raise Problem("UNSUPPORTED_MEDIA_TYPE", f"Send JSON Lines as {MEDIA_TYPE}.", headers=CLOSE)
    body.refuse_encoding(request)
    pace = Pace(services.settings)
    async with services.uploads.held(fair_key(request.scope, caller), pace):
        with await in_thread(services.blobs.writer) as pairs:
            batch = await _read(request, services, Intake(services, caller, pairs), pace)
            found = await in_thread(_keep, services, batch, pairs)
    services.batch_posted.set()
    goes_on = found.state.status == "running"
    answer = _answer(services, found, prefix, 202 if goes_on else 200)
    answer.headers["Location"] = f"{prefix}/batches/{found.batch.id}"
    return answer


async def _read(request: Request, services: Services, intake: Intake, pace: Pace) -> Batch:
    """The lines as they arrive, checked a few at a time beside the event loop."""
    chunks = body.chunks(request, services.settings.max_batch_bytes, pace, "REQUEST_TOO_LARGE")
    async for lines in lines_of(chunks):
        left = iter(lines)
        while few := list(islice(left, _LINES_AT_ONCE)):
            await PARSING.run(intake.take, few)
    return intake.finish(await in_thread(services.records.now))


def _keep(services: Services, batch: Batch, pairs: BlobWriter) -> Found:
    """The batch, kept or known. Raises Problem QUOTA_BATCHES, CONFLICT."""
    batches, most = services.batches, services.settings.quota_batches
    batches.rebuild_if_needed()
    if batches.find(batch.name) is None:
        while batches.index.count(batch.owner) >= most:
            oldest = batches.index.oldest_ended(batch.owner)
            if oldest is None:
                raise Problem("QUOTA_BATCHES", headers=RETRY_LATER)
            batches.delete(oldest, services.settings.retention_s)
    kept, created = batches.create(batch, pairs, batch.created)
    return Found(kept, batches.state(kept.name) if created else go_on(services, kept))


def _answer(services: Services, found: Found, prefix: str, status: int = 200) -> JSONResponse:
    document = document_of(found.batch, found.state, services.settings.retention_s, prefix)
    return JSONResponse(document, status_code=status, headers={"Cache-Control": "no-cache"})


@router.get(
    "/batches",
    summary="Batches, newest first",
    response_model=BatchPage,
    responses=refusals("INVALID_QUERY", "INVALID_PAGE_TOKEN"),
)
@blocking
def list_batches(
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    limit: LimitQuery = 50,
    page_token: PageTokenQuery = None,
) -> Response:
    """A page may be short and not be the last: go on while there is a `next_page_token`."""
    page = services.batches.page(caller, limit, decode_token(page_token))
    retention_s = services.settings.retention_s
    documents = [document_of(one, services.batches.state(one.name), retention_s, prefix) for one in page.records]
    return JSONResponse({"batches": documents, "next_page_token": encode_token(page.rest)})


@router.get(
    "/batches/{id}",
    summary="A batch's state",
    response_model=BatchDocument,
    responses=refusals("INVALID_QUERY", "BATCH_NOT_FOUND", "BATCH_EXPIRED"),
)
async def get_batch(
    id: str,  # noqa: A002 -- the contract's own word
    services: ServicesDep,
    caller: CallerDep,
    prefix: PrefixDep,
    wait: WaitQuery = 0,
) -> Response:
    """With `wait`, the answer comes once the batch has ended."""
    found = await wait_for(
        lambda: find_batch(services, caller, id), lambda seen: seen.state.status != "running", wait, services, caller
    )
    return _answer(services, found, prefix)


@router.get(
    "/batches/{id}/results",
    summary="A batch's results, as far as they are there",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "JSON Lines, in the order in which the pairs have ended.",
            "content": {MEDIA_TYPE: {**BINARY, "x-line-schema": reference(BatchResult)}},
            "headers": {"Batch-Status": header("The batch's `status`: unless it is `running`, no more will come.")},
        },
        **refusals("INVALID_QUERY", "BATCH_NOT_FOUND", "BATCH_EXPIRED"),
    },
)
async def batch_results(
    id: str,  # noqa: A002
    services: ServicesDep,
    caller: CallerDep,
    after: Annotated[int, Query(ge=0, le=_MOST_LINES, description="`number` of the last result that you have.")] = 0,
    limit: Annotated[int | None, Query(ge=1, le=_MOST_LINES, description="How many lines at most.")] = None,
    status: Annotated[ResultStatus | None, Query(description="Only pairs that have ended so.")] = None,
    wait: WaitQuery = 0,
) -> Response:
    """A line each. A failed pair that was repeated has two: the later one counts.

    With `wait`, the answer comes once there is a result behind `after`, or the batch has ended.
    """
    found = await wait_for(
        lambda: find_batch(services, caller, id),
        lambda seen: seen.state.lines > after or seen.state.status != "running",
        wait,
        services,
        caller,
    )
    lines = islice(_chosen(services, found, after, status), limit)
    headers = {"Batch-Status": found.state.status, "Cache-Control": "no-cache"}
    return StreamingResponse(_blocks(lines), media_type=MEDIA_TYPE, headers=headers)


def _chosen(services: Services, found: Found, after: int, status: str | None) -> Iterator[bytes]:
    lines = services.batches.results(found.batch.name, found.state, after)
    return lines if status is None else (line for line in lines if json.loads(line)["status"] == status)


async def _blocks(lines: Iterator[bytes]) -> AsyncIterator[bytes]:
    """The lines, some at a time, each time read in a thread."""
    while block := await in_thread(lambda: b"".join(islice(lines, _LINES_AT_ONCE))):
        yield block


@router.post(
    "/batches/{id}/cancel",
    summary="Stop a batch",
    response_model=BatchDocument,
    status_code=202,
    responses={
        200: {"description": "It was dismissed already.", "model": BatchDocument},
        **refusals("BATCH_NOT_FOUND", "BATCH_FINISHED", "BATCH_EXPIRED", "CONFLICT"),
    },
)
@blocking
def cancel_batch(id: str, services: ServicesDep, caller: CallerDep, prefix: PrefixDep) -> JSONResponse:  # noqa: A002
    """No further pair is handed out, and the jobs that it has started end. What is done stays, and is not repeated when
    the batch is posted again."""
    before = find_batch(services, caller, id)
    if before.state.status == "dismissed":
        return _answer(services, before, prefix)
    after = cancel(services, before.batch)
    if after.status == "finished":
        raise Problem("BATCH_FINISHED")
    return _answer(services, Found(before.batch, after), prefix, 202)


@router.delete(
    "/batches/{id}",
    summary="Forget a batch and its results",
    status_code=204,
    response_class=Response,
    responses=refusals("BATCH_NOT_FOUND", "BATCH_ACTIVE", "BATCH_EXPIRED"),
)
@blocking
def delete_batch(id: str, services: ServicesDep, caller: CallerDep) -> Response:  # noqa: A002
    """Only one that has ended: cancel it first. Its jobs stay."""
    found = find_batch(services, caller, id)
    if found.state.status == "running":
        raise Problem("BATCH_ACTIVE")
    services.batches.delete(found.batch.name)
    return Response(status_code=204)

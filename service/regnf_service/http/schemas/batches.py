"""Batches as the contract shows them: a line that comes in, the batch, a line that goes out."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from regnf_service.http.paging import NEXT_PAGE
from regnf_service.http.schemas.common import Label, Links, Moment, Outgoing, ProblemDocument
from regnf_service.http.schemas.registrations import RegisterRequest
from regnf_service.http.schemas.results import AlternativeDocument, TransformDocument, UncertaintyDocument, Verdict
from regnf_service.times import rfc3339
from regnf_state.batch_records import COUNTED, Batch, BatchState

ResultStatus = Literal["successful", "failed", "refused"]


class BatchPair(RegisterRequest):
    """A line of a batch: a registration, with a key of the caller's."""

    key: Label | None = Field(None, description="Your own name of the pair, unique in the batch; results repeat it.")


class RefusedLine(Outgoing):
    """A line that is no request."""

    line: int = Field(description="In the body, from 1 on.")
    error: ProblemDocument


class BatchCounts(Outgoing):
    """How pairs have ended, by the verdict of their result or by what went wrong."""

    registered: int = 0
    ambiguous: int = 0
    rejected: int = 0
    failed: int = Field(0, description="Their job or their fields failed. Posting the batch again repeats them.")
    refused: int = Field(0, description="Their line is no request.")


class BatchDocument(Outgoing):
    """One batch."""

    id: str
    status: Literal["running", "finished", "dismissed"]
    pairs: int = Field(description="How many lines it has.")
    waiting: int = Field(description="Pairs that were not handed to the queue.")
    active: int = Field(description="Pairs whose job waits or runs, or whose result is about to be written.")
    counts: BatchCounts
    progress: float = Field(ge=0, le=1)
    results: int = Field(description="How many lines `GET /batches/{id}/results` has.")
    passes: int = Field(1, ge=1, description="One more each time that failed pairs are repeated.")
    waits_for: str | None = Field(None, description="The reason of the limit that holds the next pair back.")
    created_at: Moment
    updated_at: Moment
    finished_at: Moment | None = None
    expires_at: Moment | None = Field(None, description="When a batch that has ended and its results will be gone.")
    errors: list[RefusedLine] = Field([], description="The first lines that are no request, 32 at most.")
    links: Links


class BatchPage(Outgoing):
    """Batches, newest first."""

    batches: list[BatchDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


class BatchResult(Outgoing):
    """A line of a batch's results: a pair that has ended."""

    number: int = Field(description="Of the result, from 1 on: `after` of the next call.")
    pair: int = Field(description="Of the pair, from 1 on.")
    line: int = Field(description="Of the pair in the body that was posted.")
    key: str | None
    job: str | None = Field(description="The job, with all of the result and its files.")
    status: ResultStatus
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    probability: float | None = None
    T_scene_object: TransformDocument | None = None
    T_object_scene: TransformDocument | None = None
    center_scene: list[float] | None = None
    uncertainty: UncertaintyDocument | None = None
    alternatives: list[AlternativeDocument] = Field([])
    object: str | None = Field(None, description="Of a search, the likeliest object.")
    metrics: dict[str, float | None] = Field({}, description="Those of the result; the seconds of all phases as one.")
    error: ProblemDocument | None = Field(None, description="Unless `status` is `successful`.")


def batch_document(batch: Batch, state: BatchState, retention_s: float, prefix: str) -> dict[str, Any]:
    """The batch as it travels."""
    done = sum(state.counts.values())
    return {
        "id": batch.id,
        "status": state.status,
        "pairs": batch.pairs,
        "waiting": max(0, batch.pairs - done - len(state.open)),
        "active": len(state.open) if state.status == "running" else 0,
        "counts": {name: state.counts.get(name, 0) for name in COUNTED},
        "progress": min(1.0, done / batch.pairs),
        "results": state.lines,
        "passes": state.passes,
        "waits_for": state.waits_for,
        "created_at": rfc3339(batch.created),
        "updated_at": rfc3339(state.updated),
        "finished_at": rfc3339(state.finished),
        "expires_at": None if state.finished is None else rfc3339(state.finished + retention_s),
        "errors": batch.problems,
        "links": _links(state, f"{prefix}/batches/{batch.id}"),
    }


def _links(state: BatchState, address: str) -> Links:
    links = {"self": address, "results": f"{address}/results"}
    return links | ({"cancel": f"{address}/cancel"} if state.status == "running" else {})

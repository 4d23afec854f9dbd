"""Batches as the contract shows them: a line that comes in, the batch, a line that goes out."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from regnf_core.document import AlternativeDocument, Outgoing, TransformDocument, UncertaintyDocument, Verdict
from regnf_core.options import Acceptance
from regnf_service.batches import COUNTED, BatchState
from regnf_service.http.query import NEXT_PAGE
from regnf_service.http.schemas.registrations import RegisterRequest
from regnf_service.http.schemas.results import Label, Links, Moment, ProblemDocument
from regnf_service.times import rfc3339
from regnf_state.batches import Batch
from regnf_state.batches import BatchSummary as Summary

ResultStatus = Literal["successful", "failed", "refused"]
_PROBLEMS_SHOWN = 32


class BatchPair(RegisterRequest):
    """A line of a batch: a registration with an optional key of the caller's choice."""

    key: Label | None = Field(
        None, description="Your own name of the pair, unique in the batch. The results repeat it."
    )


class RefusedLine(Outgoing):
    """A line that was refused: it has no job."""

    line: int = Field(description="Line number in the body, from 1.")
    error: ProblemDocument


class BatchCounts(Outgoing):
    """Number of pairs by outcome: by the verdict of the result or by the kind of failure."""

    registered: int = 0
    ambiguous: int = 0
    rejected: int = 0
    failed: int = Field(
        0,
        description="Number of pairs whose job failed, was canceled or was deleted. Posting the batch again "
        "starts these jobs again.",
    )
    refused: int = Field(0, description="Number of lines that were refused: they have no job.")


class BatchSummary(Outgoing):
    """A batch in a list."""

    id: str
    pairs: int = Field(description="Number of lines.")
    created_at: Moment = Field(description="Time of the last post.")
    expires_at: Moment = Field(description="Time at which the batch is deleted. Its jobs have their own times.")
    links: Links


class BatchDocument(BatchSummary):
    """One batch."""

    status: Literal["running", "finished", "dismissed"] = Field(
        description="`running` while a job of the batch waits or runs. Afterwards `dismissed` if its jobs were "
        "canceled, else `finished`."
    )
    active: int = Field(description="Number of pairs whose job waits or runs.")
    counts: BatchCounts
    progress: float = Field(ge=0, le=1)
    errors: list[RefusedLine] = Field([], description="The first refused lines, 32 at most.")


class BatchPage(Outgoing):
    """Batches, newest first."""

    batches: list[BatchSummary]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


class BatchResult(Outgoing):
    """A line of the results of a batch: a pair that has ended."""

    number: int = Field(description="Number of the pair, from 1. It is the value of `after` for the next call.")
    line: int = Field(description="Line number of the pair in the posted body.")
    key: str | None
    job: str | None = Field(description="The job, which has the full result and its files.")
    status: ResultStatus
    verdict: Verdict | None = None
    verdict_reason: str | None = None
    probability: float | None = None
    level: Acceptance | None = None
    T_scene_object: TransformDocument | None = None
    T_object_scene: TransformDocument | None = None
    center_scene: list[float] | None = None
    uncertainty: UncertaintyDocument | None = None
    alternatives: list[AlternativeDocument] = Field([])
    object: str | None = Field(None, description="For a search, the most probable object.")
    metrics: dict[str, float | None] = Field(
        {}, description="The metrics of the result, with one sum for the time of all phases."
    )
    error: ProblemDocument | None = Field(None, description="Null if `status` is `successful`.")


def summary_document(batch: Summary, retention_s: float, prefix: str) -> dict[str, Any]:
    """What a list tells of a batch, as it travels."""
    return {
        "id": batch.id,
        "pairs": batch.pairs,
        "created_at": rfc3339(batch.created),
        "expires_at": rfc3339(batch.created + retention_s),
        "links": _links(f"{prefix}/batches/{batch.id}"),
    }


def batch_document(batch: Batch, state: BatchState, retention_s: float, prefix: str) -> dict[str, Any]:
    pairs = len(batch.pairs)
    refused = [{"line": pair.line, "error": pair.error} for pair in batch.pairs if pair.error is not None]
    return summary_document(Summary(batch.id, batch.created, pairs), retention_s, prefix) | {
        "status": state.status,
        "active": state.active,
        "counts": {name: state.counts.get(name, 0) for name in COUNTED},
        "progress": (pairs - state.active) / pairs,
        "errors": refused[:_PROBLEMS_SHOWN],
    }


def _links(address: str) -> Links:
    return {"self": address, "results": f"{address}/results", "cancel": f"{address}/cancel"}

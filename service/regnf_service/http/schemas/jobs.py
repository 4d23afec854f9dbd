"""Jobs as the contract shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import zip_longest
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, WithJsonSchema

from regnf_core.document import Outgoing, Sha256, Verdict
from regnf_core.options import Acceptance
from regnf_service.http.query import NEXT_PAGE
from regnf_service.http.schemas.results import Links, Moment, ProblemDocument, outgoing_problem
from regnf_service.times import rfc3339
from regnf_state.ownership import sha256_of
from regnf_state.records import ACTIVE, WARNINGS, JobRecord
from regnf_state.redis.webhook_outbox import Delivery

Status = Literal["accepted", "running", "successful", "failed", "dismissed"]
_PHASES = ["loading", "sampling", "initializing", "optimizing", "verifying", "exporting", "composing", "rendering"]
# said in the contract alone: a record that an older version wrote is shown as it is
_Phase = Annotated[str, WithJsonSchema({"type": "string", "enum": _PHASES})]
_Verdict = Annotated[str, WithJsonSchema({"type": "string", "enum": list(get_args(Verdict))})]
_Level = Annotated[str, WithJsonSchema({"type": "string", "enum": list(get_args(Acceptance))})]
_AS_RECORDED = (
    "id", "kind", "status", "phase", "progress", "cancel_requested", "engine",
    "verdict", "probability", "level", "object_found",
)  # fmt: skip
_NOT_ASKED_AGAIN = frozenset({"version", "webhook"})


class WebhookDocument(Outgoing):
    """Delivery of the message about the job's end."""

    url: str
    state: Literal["waiting", "pending", "delivered", "failed"] | None = Field(
        None,
        description="State of the message: waiting for the job's end; to be sent (again); received; or given up. "
        "Null in lists.",
    )
    sends: int = 0
    last_status: int | None = Field(None, description="HTTP status of the receiver's last response.")
    last_error: str | None = Field(None, description="A stable word: the reason why there was no response.")
    next_at: Moment | None = None
    delivered_at: Moment | None = None


class JobDocument(Outgoing):
    """One job. `successful` means that it has a result; the verdict of a registration may still be `rejected`."""

    id: str
    kind: Literal["registration", "render"]
    status: Status
    phase: _Phase | None = Field(
        None,
        description="The current or last phase: loading, sampling, initializing, optimizing, verifying or "
        "exporting. For a rendering: loading, composing, rendering or exporting.",
    )
    progress: float = Field(0.0, ge=0, le=1)
    queue_position: int | None = Field(
        None, description="Position in the queue, 1 is next. Null for a job that is not waiting."
    )
    attempts: int = Field(1, ge=1, description="How often a worker has started the job.")
    cancel_requested: bool = False
    created_at: Moment
    updated_at: Moment
    started_at: Moment | None = None
    finished_at: Moment | None = None
    expires_at: Moment | None = Field(None, description="Time at which a finished job and its artifacts are deleted.")
    inputs: dict[str, Any] = Field(
        description="scene, object or the number of candidates, detection, seed, initial_transform, pictures, and "
        "the SHA-256 of the full options. For a rendering: scene, the kinds of its edits, frames, "
        "size, mode, outputs and seed."
    )
    engine: dict[str, Any] = Field(
        {}, description="Version, revision and device of the engine. Results may differ between revisions."
    )
    warnings: dict[str, list[str]] = Field(
        {},
        description="Warnings of the imports of `scene` and `object`: their stable words. The result has the full "
        "sentences.",
    )
    verdict: _Verdict | None = Field(None, description="The verdict of the result, for a successful job.")
    probability: float | None = Field(None, description="The probability of the result.")
    level: _Level | None = Field(None, description="The named level of the result.")
    object_found: Sha256 | None = Field(
        None,
        description="The object of the result, for a successful search. If the verdict is `rejected`, no "
        "candidate was found.",
    )
    error: ProblemDocument | None = Field(None, description="Why the job failed.")
    webhooks: list[WebhookDocument] = Field(
        [], description="Receivers of the message about the job's end, in the order of the requests."
    )
    links: Links


class JobPage(Outgoing):
    """Jobs, newest first."""

    jobs: list[JobDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


def job_document(
    record: JobRecord, queue_position: int | None, retention_s: float, prefix: str, deliveries: Sequence[Delivery] = ()
) -> dict[str, Any]:
    """The job as it travels. prefix: of the API's paths · deliveries: of all its webhooks, or none where not asked."""
    return {
        **{name: getattr(record, name) for name in _AS_RECORDED},
        **{f"{name}_at": rfc3339(getattr(record, name)) for name in ("created", "updated", "started", "finished")},
        "queue_position": queue_position,
        "attempts": record.attempt,
        "expires_at": None if record.finished is None else rfc3339(record.finished + retention_s),
        "inputs": {name: value for name, value in record.inputs.items() if name != WARNINGS},
        "warnings": record.inputs.get(WARNINGS) or {},
        "error": outgoing_problem(record.error),
        "webhooks": [_webhook(url, one) for url, one in zip_longest(record.webhooks, deliveries)],
        "links": _links(record, f"{prefix}/jobs/{record.id}"),
    }


def request_document(request: dict[str, Any]) -> dict[str, Any]:
    """The request of a registration, to be posted again. request: of the job's record as it was accepted."""
    asked = {name: value for name, value in request.items() if value is not None and name not in _NOT_ASKED_AGAIN}
    asked["scene"] = sha256_of(asked["scene"])
    if "object" in asked:
        asked["object"] = sha256_of(asked["object"])
    else:
        asked["candidates"] = [sha256_of(one) for one in asked["candidates"]]
    asked["detection"] = _as_asked(asked["detection"])
    return asked


def _as_asked(detection: Any) -> Any:
    """Of a box its members that were given; of objects in images each one's."""
    if isinstance(detection, list | tuple):
        return [_as_asked(one) for one in detection]
    return {name: value for name, value in detection.items() if value is not None}


def _webhook(url: str, delivery: Delivery | None) -> dict[str, Any]:
    document: dict[str, Any] = {"url": url, "state": None}
    if delivery is not None:
        times = {"next_at": rfc3339(delivery.next_at), "delivered_at": rfc3339(delivery.delivered_at)}
        document |= asdict(delivery) | times
    return document


def _links(record: JobRecord, address: str) -> Links:
    links = {"self": address, "events": f"{address}/events", "view": f"{address}/view"}
    if record.status in ACTIVE:
        links["cancel"] = f"{address}/cancel"
    if record.status == "successful":
        links["result"] = f"{address}/result"
    return links

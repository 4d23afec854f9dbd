"""Recordings as the contract shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from regnf_core.document import Outgoing, Sha256
from regnf_service.http.query import NEXT_PAGE
from regnf_service.http.schemas.fields import field_document
from regnf_service.http.schemas.results import Links, Moment, ProblemDocument
from regnf_state.records import FieldRecord

_SHOWN = ("sha256", "state", "bytes", "label", "report", "queue_position", "error", "created_at", "updated_at")


class RecordingDocument(Outgoing):
    """One recording. `validating` until its import has ended; a registration waits for that."""

    sha256: Sha256
    state: Literal["validating", "ready", "rejected"]
    bytes: int
    label: str | None = None
    after: Sha256 | None = Field(None, description="Of one that a frame was added to: the recording before.")
    report: dict[str, Any] = Field(
        {}, description="What the import found: layout, names of the frames, sizes, bounds, notes, warnings."
    )
    queue_position: int | None = Field(None, description="1 is next; null for an import that runs or has ended.")
    error: ProblemDocument | None = Field(None, description="Why the recording was rejected.")
    created_at: Moment
    updated_at: Moment
    links: Links


class RecordingPage(Outgoing):
    """Recordings, newest first."""

    recordings: list[RecordingDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


def recording_document(record: FieldRecord, prefix: str, queue_position: int | None = None) -> dict[str, Any]:
    """The recording as it travels; ``prefix`` is what the API's paths begin with."""
    shown = field_document(record, prefix, queue_position)
    address = f"{prefix}/recordings/{shown['sha256']}"
    links = {"self": address} | ({"picture": f"{address}/frames/0/color.png"} if record.state == "ready" else {})
    return {name: shown[name] for name in _SHOWN} | {"after": record.description.get("after"), "links": links}

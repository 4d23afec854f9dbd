"""Fields as the contract shows them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from regnf_service.http.paging import NEXT_PAGE
from regnf_service.http.schemas.common import Links, Outgoing, ProblemDocument, Sha256, outgoing_problem
from regnf_service.http.schemas.results import SymmetryDocument
from regnf_service.times import rfc3339
from regnf_state.ownership import sha256_of
from regnf_state.records import FieldRecord


class FieldDocument(Outgoing):
    """One field. `validating` until its import has ended; only a `ready` field can be registered."""

    sha256: Sha256
    state: Literal["validating", "ready", "rejected"]
    bytes: int
    label: str | None = None
    description: dict[str, Any] = Field({}, description="What the uploader said that the file does not.")
    report: dict[str, Any] = Field({}, description="What the import found: family, bounds, parameters, plausibility.")
    symmetry: SymmetryDocument | None = Field(
        None, description="The object's own, found by the first job that registers the field as an object."
    )
    error: ProblemDocument | None = Field(None, description="Why the field was rejected.")
    created_at: str
    updated_at: str
    links: Links


class FieldPage(Outgoing):
    """Fields, newest first."""

    fields: list[FieldDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


def field_document(record: FieldRecord, prefix: str) -> dict[str, Any]:
    """The field as it travels; ``prefix`` is what the API's paths begin with."""
    return {
        "sha256": sha256_of(record.sha256),
        "state": record.state,
        "bytes": record.bytes,
        "label": record.label,
        "description": record.description,
        "report": record.report,
        "symmetry": record.symmetry,
        "error": outgoing_problem(record.error),
        "created_at": rfc3339(record.created),
        "updated_at": rfc3339(record.updated),
        "links": _links(record, f"{prefix}/fields/{sha256_of(record.sha256)}"),
    }


def _links(record: FieldRecord, address: str) -> Links:
    return {"self": address} | ({"preview": f"{address}/preview.png"} if record.state == "ready" else {})

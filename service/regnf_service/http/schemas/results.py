"""What a registration found, as the contract shows it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, WithJsonSchema

from regnf_core.document import Address, Outgoing
from regnf_core.library_entries import LABEL_PATTERN
from regnf_state.reasons import whole_problem

# Pieces that several schemas share.

Coordinate = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Moment = Annotated[str, WithJsonSchema({"type": "string", "format": "date-time"})]
"""A time as ``rfc3339`` writes it."""
Links = dict[str, Address]
Label = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=LABEL_PATTERN)]


class Incoming(BaseModel):
    """Base of what clients send: unknown members and values of another type are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ProblemEntry(Outgoing):
    """One fault: a JSON Pointer into the body, or the name of a query parameter or header."""

    pointer: str | None = None
    parameter: str | None = None
    detail: str


class ReadingDocument(Outgoing):
    """One of several functions that an upload may be."""

    name: str
    description: dict[str, Any] = Field(description="The entries that choose it: send them with PATCH.")
    picture: Address | None = Field(None, description="Its picture, for as long as the upload is kept.")


class ProblemDocument(Outgoing):
    """RFC 9457 problem details. Programs switch on `reason`, never on text."""

    type: Address
    title: str
    status: Annotated[int, Field(ge=400, le=599)]
    reason: str
    detail: str
    hint: str | None = Field(None, description="What to do next, for people.")
    instance: str | None = None
    request_id: str | None = None
    errors: list[ProblemEntry] = Field([])
    candidates: list[ReadingDocument] = Field(
        [], description="With a field's `LAYOUT_AMBIGUOUS`: what it may be, the likeliest first."
    )
    error: ProblemDocument | None = Field(None, description="With `JOB_FAILED`: the job's own problem.")
    offset: int | None = Field(None, description="Of an upload in pieces: how many bytes have arrived.")


def outgoing_problem(error: dict[str, Any] | None) -> dict[str, Any] | None:
    """A record's problem as it travels."""
    return None if error is None else whole_problem(error)


# What the service says about itself.


class HealthDocument(Outgoing):
    """The process answers."""

    status: Literal["ok"]


class ReadyDocument(Outgoing):
    """Every part the service needs is there."""

    status: Literal["ready"]
    checks: dict[str, bool]


class VersionDocument(Outgoing):
    """What runs here."""

    name: Literal["regnf"]
    version: str
    python: str


class IndexDocument(Outgoing):
    """Every address, each with what it is for."""

    name: Literal["regnf"]
    version: str
    addresses: dict[str, str]


class DemoFile(Outgoing):
    """A field file to fetch and to upload."""

    name: str
    bytes: int
    address: str


class DemoDocument(Outgoing):
    """A scene and an object to try, and a detection as `POST /register` takes it."""

    scene: DemoFile
    object: DemoFile
    detection: dict[str, Any]

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
    """One error: a JSON Pointer into the body, or the name of a query parameter or header."""

    pointer: str | None = None
    parameter: str | None = None
    detail: str


class ReadingDocument(Outgoing):
    """One of several possible readings of an uploaded file."""

    name: str
    description: dict[str, Any] = Field(
        description="The import options that select this reading. Send them with PATCH."
    )
    picture: Address | None = Field(None, description="Its picture. It is there while the upload is kept.")


class ProblemDocument(Outgoing):
    """RFC 9457 problem details. Programs should branch on `reason`, never on the text."""

    type: Address
    title: str
    status: Annotated[int, Field(ge=400, le=599)]
    reason: str
    detail: str
    hint: str | None = Field(None, description="What the user can do next.")
    instance: str | None = None
    request_id: str | None = None
    errors: list[ProblemEntry] = Field([])
    candidates: list[ReadingDocument] = Field(
        [], description="With a field's `LAYOUT_AMBIGUOUS`: the possible readings of the file, the most probable first."
    )
    error: ProblemDocument | None = Field(None, description="With `JOB_FAILED`: the reason why the job failed.")
    offset: int | None = Field(None, description="For an upload in pieces: the number of bytes that have arrived.")


def outgoing_problem(error: dict[str, Any] | None) -> dict[str, Any] | None:
    """A record's problem as it travels."""
    return None if error is None else whole_problem(error)


# State, version and contract of the service.


class HealthDocument(Outgoing):
    """The process responds."""

    status: Literal["ok"]


class ReadyDocument(Outgoing):
    """All parts that the service needs are available."""

    status: Literal["ready"]
    checks: dict[str, bool]


class VersionDocument(Outgoing):
    """Version of the service."""

    name: Literal["regnf"]
    version: str
    python: str


class IndexDocument(Outgoing):
    """All addresses, each with its purpose."""

    name: Literal["regnf"]
    version: str
    addresses: dict[str, str]


class DemoFile(Outgoing):
    """A field file, which you can download and upload."""

    name: str
    bytes: int
    address: str


class DemoDocument(Outgoing):
    """An example scene and object, and a detection for `POST /register`."""

    scene: DemoFile
    object: DemoFile
    detection: dict[str, Any]

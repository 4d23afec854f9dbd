"""Fields as the contract shows them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, GetJsonSchemaHandler, TypeAdapter
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from regnf_core.document import Outgoing, Sha256, SymmetryDocument
from regnf_core.importing.upload_description import UploadDescription
from regnf_service.http.query import NEXT_PAGE
from regnf_service.http.schemas.results import Incoming, Label, Links, Moment, ProblemDocument, outgoing_problem
from regnf_service.times import rfc3339
from regnf_state.ownership import sha256_of
from regnf_state.records import CANDIDATES, FieldRecord


class SettingsDocument(Outgoing):
    """A file that came with an upload."""

    name: str
    sha256: Sha256
    bytes: int


class EntryNamed(Outgoing):
    """Under which name a library has the field."""

    name: str
    tags: list[str] = Field([])


class FieldDocument(Outgoing):
    """One field, or one recording. `validating` until its import has ended; only what is `ready` can be registered."""

    sha256: Sha256
    state: Literal["validating", "ready", "rejected"]
    bytes: int
    label: str | None = None
    description: dict[str, Any] = Field({}, description="What the uploader said that the file does not.")
    settings: SettingsDocument | None = Field(None, description="The file of settings that came with the upload.")
    cameras: SettingsDocument | None = Field(None, description="The file that says where its cameras stood.")
    report: dict[str, Any] = Field(
        {},
        description="What the import found: family, bounds, those of the surface, parameters, plausibility; of a "
        "recording, with the `kind` `recording`, its layout, frames, sizes, bounds and notes.",
    )
    symmetry: SymmetryDocument | None = Field(
        None, description="The object's own, found by the first job that registers the field as an object."
    )
    library: EntryNamed | None = Field(None, description="Its entry in the library: `GET /library/{name}`.")
    queue_position: int | None = Field(
        None, description="1 is next; null for an import that runs or has ended, and in lists."
    )
    views: Literal["pending", "ready", "none"] | None = Field(
        None,
        description="Of a ready field: whether its mesh and picture, which follow when workers have time, are still to "
        "be made, are there, or cannot be made. Null also of a field from before they followed.",
    )
    error: ProblemDocument | None = Field(None, description="Why the field was rejected.")
    kept_until: Moment | None = Field(
        None, description="Until when the upload can be imported anew with another description: PATCH. Null: it cannot."
    )
    created_at: Moment
    updated_at: Moment
    links: Links


class UploadProgress(Outgoing):
    """An upload in pieces that is not finished."""

    sha256: Sha256
    offset: int = Field(description="How many bytes have arrived: where the next piece begins.")
    bytes: int = Field(description="How many the file has.")


class _DocumentedAsDescription:
    """Has the contract show an UploadDescription where a part of one is taken."""

    @classmethod
    def __get_pydantic_json_schema__(cls, _: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return handler(TypeAdapter(UploadDescription).core_schema)


class FieldChange(Incoming):
    """What is to be changed of a field. What is left out stays as it is."""

    description: Annotated[dict[str, Any], _DocumentedAsDescription] | None = Field(
        None,
        description="Entries to add to what was said, or to replace; null takes an entry back (RFC 7396). Another "
        "description is another function: the kept bytes are imported anew.",
    )
    label: Label | None = Field(None, description="A name for people; null: none. Nothing is imported for it.")

    def description_change(self, held: dict[str, Any]) -> dict[str, Any]:
        """What is to be changed of what is ``held``; null for the whole takes back all of it."""
        if "description" in self.model_fields_set and self.description is None:
            return dict.fromkeys(held)
        return self.description or {}


class FieldPage(Outgoing):
    """Fields, newest first."""

    fields: list[FieldDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


class RecordingPage(Outgoing):
    """Recordings, newest first."""

    recordings: list[FieldDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


def field_document(record: FieldRecord, prefix: str, queue_position: int | None = None) -> dict[str, Any]:
    """The field as it travels; ``prefix`` is what the API's paths begin with."""
    address = f"{prefix}/{'recordings' if record.is_recording else 'fields'}/{sha256_of(record.sha256)}"
    return {
        **{name: getattr(record, name) for name in ("state", "bytes", "label", "symmetry", "views")},
        "sha256": sha256_of(record.sha256),
        "description": record.said,
        "settings": None if record.settings is None else record.settings._asdict(),
        "cameras": None if record.cameras is None else record.cameras._asdict(),
        "report": record.report,
        "library": None if record.library is None else {name: record.library[name] for name in ("name", "tags")},
        "queue_position": queue_position,
        "error": None if record.error is None else outgoing_problem(_error(record, address)),
        "kept_until": rfc3339(record.original_until),
        "created_at": rfc3339(record.created),
        "updated_at": rfc3339(record.updated),
        "links": _links(record, address),
    }


def _error(record: FieldRecord, address: str) -> dict[str, Any]:
    error = record.error or {}
    if CANDIDATES not in error:
        return error
    pictures = [
        f"{address}/candidates/{number}.png" if record.has_candidate_picture(number) else None
        for number in range(1, len(error[CANDIDATES]) + 1)
    ]
    return error | {
        CANDIDATES: [one | {"picture": picture} for one, picture in zip(error[CANDIDATES], pictures, strict=True)]
    }


def _links(record: FieldRecord, address: str) -> Links:
    shown = {"preview": f"{address}/preview.png", "mesh": f"{address}/mesh.glb"}
    if record.is_recording:
        shown = {"picture": f"{address}/frames/0/color.png"}
    return {"self": address} | (shown if record.state == "ready" else {})

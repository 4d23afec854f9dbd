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
    """A file that was uploaded with a field."""

    name: str
    sha256: Sha256
    bytes: int


class EntryNamed(Outgoing):
    """The library entry of the field."""

    name: str
    tags: list[str] = Field([])


class FieldDocument(Outgoing):
    """One field, or one recording. It is `validating` until its import has ended. Only a `ready` one can be
    registered."""

    sha256: Sha256
    state: Literal["validating", "ready", "rejected"]
    bytes: int
    label: str | None = None
    description: dict[str, Any] = Field({}, description="The import options of the upload.")
    settings: SettingsDocument | None = Field(
        None, description="The trainer's config file that was uploaded with the field."
    )
    cameras: SettingsDocument | None = Field(
        None, description="The file with the camera poses that was uploaded with the field."
    )
    report: dict[str, Any] = Field(
        {},
        description="The report of the import. For a field: family, bounds, bounds of the surface, parameters and "
        "plausibility. For a recording (`kind` is `recording`): layout, frames, sizes, bounds and "
        "notes.",
    )
    symmetry: SymmetryDocument | None = Field(
        None, description="The object's symmetry. The first job that registers the field as an object detects it."
    )
    library: EntryNamed | None = Field(None, description="Its library entry: `GET /library/{name}`.")
    queue_position: int | None = Field(
        None, description="Position in the queue, 1 is next. Null for an import that runs or has ended, and in lists."
    )
    views: Literal["pending", "ready", "none"] | None = Field(
        None,
        description="State of the mesh and the picture of a ready field: not made yet, made, or impossible. "
        "Workers make them when they have time. Null if it is unknown.",
    )
    error: ProblemDocument | None = Field(None, description="Why the field was rejected.")
    kept_until: Moment | None = Field(
        None,
        description="Until this time the file can be imported again with other import options (PATCH). Null: it "
        "cannot.",
    )
    created_at: Moment
    updated_at: Moment
    links: Links


class UploadProgress(Outgoing):
    """An upload in pieces that is not finished."""

    sha256: Sha256
    offset: int = Field(description="Number of bytes that have arrived. The next piece starts here.")
    bytes: int = Field(description="Size of the file, bytes.")


class _DocumentedAsDescription:
    """Has the contract show an UploadDescription where a part of one is taken."""

    @classmethod
    def __get_pydantic_json_schema__(cls, _: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return handler(TypeAdapter(UploadDescription).core_schema)


class FieldChange(Incoming):
    """Changes of a field. Members that are left out are unchanged."""

    description: Annotated[dict[str, Any], _DocumentedAsDescription] | None = Field(
        None,
        description="Import options to add or to replace; null removes an option (RFC 7396). If the options "
        "change, the kept file is imported again.",
    )
    label: Label | None = Field(
        None, description="A name for display; null: none. A change of the name causes no new import."
    )

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

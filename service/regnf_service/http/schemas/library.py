"""A library's entries as the contract shows them, and how requests name them."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import quote

from pydantic import AfterValidator, Discriminator, Field, StringConstraints, Tag, model_validator

from regnf_core.document import Outgoing, Sha256, SymmetryDocument
from regnf_core.errors import InvalidInputError
from regnf_core.library_entries import (
    LABEL_PATTERN,
    MAX_NAME,
    MAX_NOTE,
    MAX_ORDER,
    MAX_TAG,
    MAX_TAGS,
    checked_name,
    checked_symmetry,
    checked_tags,
    text_pattern,
)
from regnf_service.http.query import NEXT_PAGE
from regnf_service.http.schemas.results import Incoming, Links, Moment
from regnf_service.times import rfc3339
from regnf_state.ownership import sha256_of
from regnf_state.record_store import LibraryEntry

MAX_SELECTED = 512
"""Objects that one search takes."""
_FINITE = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Unit = Literal["m", "cm", "mm", "in", "ft"]


def _name(text: str) -> str:
    try:
        return checked_name(text)
    except InvalidInputError as error:
        raise ValueError(str(error)) from error


def _tag(text: str) -> str:
    try:
        return checked_tags([text])[0]
    except InvalidInputError as error:
        raise ValueError(str(error)) from error


def _text(most: int) -> dict[str, Any]:
    return {"minLength": 1, "maxLength": most, "pattern": text_pattern(most)}


EntryName = Annotated[str, AfterValidator(_name), Field(json_schema_extra=_text(MAX_NAME))]
EntryTag = Annotated[str, AfterValidator(_tag), Field(json_schema_extra=_text(MAX_TAG))]
Tags = Annotated[list[EntryTag], Field(max_length=MAX_TAGS)]
Note = Annotated[str, StringConstraints(min_length=1, max_length=MAX_NOTE, pattern=LABEL_PATTERN)]


class SaidSymmetry(Incoming):
    """The rotations that map the object onto itself, as given by a user."""

    order: Annotated[int, Field(ge=1, le=MAX_ORDER)] = Field(
        description="Number of rotations, including the identity. With `continuous`: 1, or 2 if both ends of the "
        "axis look alike."
    )
    axis: Annotated[list[_FINITE], Field(min_length=3, max_length=3)] | None = Field(
        None, description="The axis of all rotations, object frame. Any length except 0."
    )
    continuous: bool = Field(
        False, description="Whether every rotation about the axis is a symmetry. An axis is required then."
    )

    @model_validator(mode="after")
    def _is_one(self) -> SaidSymmetry:
        try:
            checked_symmetry(self.model_dump())
        except InvalidInputError as error:
            raise ValueError(str(error)) from error
        return self


class _Notes(Incoming):
    tags: Tags = Field([], description="Tags, by which several entries can be selected together.")
    unit: Unit | None = Field(None, description="The unit of the object's field, if it is known.")
    note: Note | None = Field(None, description="A comment.")
    symmetry: SaidSymmetry | None = Field(
        None, description="Replaces the detected symmetry, for programs that use the pose. null: the detected one."
    )


class NewEntry(_Notes):
    """A field that becomes an entry of the library."""

    name: EntryName
    field: Sha256


class EntryChange(_Notes):
    """Changes of an entry. Members that are left out are unchanged."""

    name: EntryName | None = Field(None, description="The new name.")


class EntryDocument(Outgoing):
    """One object of the library."""

    name: str
    field: Sha256
    state: Literal["validating", "ready", "rejected"] = Field(description="The state of its field.")
    tags: list[str] = Field([])
    unit: Unit | None = None
    note: str | None = None
    symmetry: SymmetryDocument | None = Field(
        None, description="The symmetry in use: the given one if there is one, else the detected one."
    )
    symmetry_source: Literal["said", "detected"] | None = Field(
        None,
        description="Null: no symmetry was given, and the detection has not run yet. A worker runs it.",
    )
    bounds: list[list[float]] | None = Field(None, description="Bounds of the field: lowest and highest corner.")
    surface_bounds: list[list[float]] | None = Field(None, description="Bounds of its surface: the size of the object.")
    added_at: Moment
    updated_at: Moment
    links: Links


class EntryPage(Outgoing):
    """A page of a library."""

    entries: list[EntryDocument]
    next_page_token: str | None = Field(None, description=NEXT_PAGE)


class LibraryFilter(Incoming):
    """Entries with any of these names or any of these tags; `{}`: all entries."""

    names: Annotated[list[EntryName], Field(min_length=1, max_length=MAX_SELECTED)] | None = None
    tags: Annotated[list[EntryTag], Field(min_length=1, max_length=MAX_TAGS)] | None = None


class LibraryReference(Incoming):
    """An object by the name of its entry in the caller's library."""

    library: EntryName


class LibrarySelection(Incoming):
    """Objects of the caller's library."""

    library: LibraryFilter


BY_DIGEST, BY_LIBRARY = "by digest", "named in the library"


def by_library(value: Any) -> str:
    """Which of both ways of naming fields a value takes."""
    inside = "library" in value if isinstance(value, dict) else isinstance(value, LibraryReference | LibrarySelection)
    return BY_LIBRARY if inside else BY_DIGEST


Named = Annotated[LibraryReference, Tag(BY_LIBRARY)]
Selected = Annotated[LibrarySelection, Tag(BY_LIBRARY)]
Choice = Discriminator(by_library)


def entry_document(entry: LibraryEntry, prefix: str) -> dict[str, Any]:
    field, notes = entry.field, entry.notes
    address = f"{prefix}/library/{quote(notes.name, safe='')}"
    at_field = f"{prefix}/fields/{sha256_of(field.sha256)}"
    source = "said" if notes.symmetry is not None else None if field.symmetry is None else "detected"
    shown = {"preview": f"{at_field}/preview.png", "mesh": f"{at_field}/mesh.glb", "file": f"{address}/file"}
    return {
        "name": notes.name,
        "field": sha256_of(field.sha256),
        "state": field.state,
        "tags": list(notes.tags),
        "unit": notes.unit,
        "note": notes.note,
        "symmetry": entry.symmetry,
        "symmetry_source": source,
        "bounds": field.report.get("bounds"),
        "surface_bounds": field.report.get("surface_bounds"),
        "added_at": rfc3339(entry.added),
        "updated_at": rfc3339(field.updated),
        "links": {"self": address, "field": at_field} | (shown if field.state == "ready" else {}),
    }

"""A field as a user names it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from regnf_core.errors import InvalidInputError
from regnf_core.field_notes import FieldNotes
from regnf_core.field_source import Role, find_source
from regnf_core.fields.base import SdfField
from regnf_core.in_memory import FieldWarning, HasGeometry, HasPoints, HasVertices, field_of
from regnf_core.loading import import_smallest_first, load_field

FieldLike = SdfField | str | os.PathLike[str] | HasVertices | HasPoints | HasGeometry
"""An open field; the path of a file, a training run's folder or an archive of one; or a mesh or a cloud in memory, see
:func:`regnf_core.in_memory.field_of`."""


@dataclass(frozen=True)
class Opened:
    """A field, its name, and what its import said; both None for a field that the caller has opened."""

    field: SdfField
    name: str | None = None
    notes: FieldNotes | None = None


def opened(field: FieldLike, role: Role | None = None) -> Opened:
    """The field that is meant; a path is opened, as what it will be used as. Raises what ``open_field`` does."""
    if isinstance(field, str | os.PathLike):
        loaded = load_field(find_source(Path(field), role=role))
        for warning in loaded.notes.warnings:
            warnings.warn(f"{field}: {warning}", FieldWarning, stacklevel=4)
        return Opened(loaded.field, str(field), loaded.notes)
    return Opened(field_of(field, role))


def opened_pair(scene: FieldLike, obj: FieldLike) -> tuple[Opened, Opened]:
    """Both; what is refused is refused before a large file is imported. Raises what ``open_field`` does."""
    given: dict[Role, FieldLike] = {"scene": scene, "object": obj}
    sources = {
        role: find_source(Path(one), role=role) for role, one in given.items() if isinstance(one, str | os.PathLike)
    }
    found = {role: opened(one, role) for role, one in given.items() if role not in sources}
    import_smallest_first(sources.values())
    for role in sources:
        found[role] = opened(given[role], role)
    return found["scene"], found["object"]


def opened_several(fields: Sequence[FieldLike], role: Role) -> list[Opened]:
    """The same for a list. Raises InvalidInputError (NO_FIELD) for what is no list."""
    if isinstance(fields, str | os.PathLike | SdfField) or not isinstance(fields, Sequence):
        message = f"the {role}s are a {type(fields).__name__}, expected a list"
        raise InvalidInputError(message, reason="NO_FIELD", hint=f"Write a list: [{role}].")
    return [opened(one, role) for one in fields]


def notes_of(scene: Opened, obj: Opened) -> dict[str, FieldNotes] | None:
    """What is known of the imports, by role; None where nothing is."""
    found = {"scene": scene.notes, "object": obj.notes}
    return {name: notes for name, notes in found.items() if notes is not None} or None

"""The entries of callers' libraries: each is a part of the record of the field that it names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.library_entries import EntryNotes
from regnf_state.records import FieldRecord, RecordError


class NameTakenError(RecordError):
    """Another entry of the caller's library has the name."""

    reason = "LIBRARY_NAME_TAKEN"


@dataclass(frozen=True)
class LibraryEntry:
    """What a library says of a field, and since when; ``field`` as it is now."""

    field: FieldRecord
    notes: EntryNotes
    added: float

    @classmethod
    def of(cls, field: FieldRecord) -> LibraryEntry | None:
        """The entry of a field; None where it has none."""
        said = field.library
        return None if said is None else cls(field, EntryNotes.from_dict(said), float(said["added"]))

    @property
    def symmetry(self) -> dict[str, Any] | None:
        """The one that holds: what people say goes before what was detected."""
        return self.notes.symmetry or self.field.symmetry


def recorded(notes: EntryNotes, added: float) -> dict[str, Any]:
    """An entry as the field's record keeps it."""
    return notes.to_dict() | {"added": added}

"""The store that keeps the records of fields and jobs: what every kind of store can do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from regnf_core.library_entries import EntryNotes
from regnf_state.records import FieldRecord, RecordError

# The entries of callers' libraries: each is a part of the record of the field that it names.


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
        said = field.library
        return None if said is None else cls(field, EntryNotes.from_dict(said), float(said["added"]))

    @property
    def symmetry(self) -> dict[str, Any] | None:
        """The one that holds: what people say goes before what was detected."""
        return self.notes.symmetry or self.field.symmetry


def recorded(notes: EntryNotes, added: float) -> dict[str, Any]:
    """An entry as the field's record keeps it."""
    return notes.to_dict() | {"added": added}


# Pages of a list of records, newest first.

_Record = TypeVar("_Record")
Position = tuple[float, str]
"""(created, name) of a record in a list."""

LOOKED_AT = 200
"""The most records that one page is chosen from: a filter that finds nothing takes a hundredth of a second a page."""
PAGE_BYTES = 512 * 1024
"""The most bytes of records that one page is chosen from, unless its first record alone has more. An answer has hardly
more than the records that it shows."""


@dataclass(frozen=True)
class Page(Generic[_Record]):
    """Records of a list, and the position after which the next page begins; None when this is the last.

    A page may hold fewer records than were requested, or none, and not be the last.
    """

    records: list[_Record]
    rest: Position | None


def all_of(page_after: Callable[[Position | None], Page[_Record]]) -> Iterator[_Record]:
    """All records of a list, page by page."""
    rest: Position | None = None
    while True:
        page = page_after(rest)
        yield from page.records
        rest = page.rest
        if rest is None:
            return

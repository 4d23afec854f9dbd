"""A caller's library: entries made, changed, taken out."""

from __future__ import annotations

from regnf_core.library_entries import EntryNotes
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.ownership import reference_of
from regnf_state.record_store import LibraryEntry
from regnf_state.records import FieldRecord


def find_entry(services: Services, caller: str, name: str) -> LibraryEntry:
    """Raises Problem LIBRARY_ENTRY_NOT_FOUND."""
    (entry,) = services.records.entries_named(caller, [name])
    if entry is None:
        raise Problem("LIBRARY_ENTRY_NOT_FOUND")
    return entry


def add_entry(services: Services, caller: str, sha256: str, notes: EntryNotes) -> tuple[LibraryEntry, bool]:
    """The entry, and whether it is new. Raises Problem FIELD_NOT_FOUND, FIELD_REJECTED, RECORDING_UNSUITABLE,
    FIELD_IN_LIBRARY, NameTakenError."""
    field = services.records.get_field(reference_of(caller, sha256))
    if field is None:
        raise Problem("FIELD_NOT_FOUND")
    if field.state == "rejected":
        raise Problem("FIELD_REJECTED")
    if field.is_recording:
        raise Problem("RECORDING_UNSUITABLE")
    held = LibraryEntry.of(field)
    if held is not None and held.notes == notes:
        return held, False
    if held is not None:
        raise Problem("FIELD_IN_LIBRARY")
    field = services.records.set_entry(field, notes)
    if field.state == "ready" and field.symmetry is None:
        services.queue.enqueue_import(field.sha256, field.attempt)  # its model is made, and its symmetry found
    return _entry_of(field), True


def change_entry(services: Services, caller: str, name: str, notes: EntryNotes) -> LibraryEntry:
    """Raises Problem LIBRARY_ENTRY_NOT_FOUND, NameTakenError."""
    entry = find_entry(services, caller, name)
    return entry if entry.notes == notes else _entry_of(services.records.set_entry(entry.field, notes))


def remove_entry(services: Services, caller: str, name: str) -> None:
    """Raises Problem LIBRARY_ENTRY_NOT_FOUND."""
    services.records.set_entry(find_entry(services, caller, name).field, None)


def _entry_of(field: FieldRecord) -> LibraryEntry:
    entry = LibraryEntry.of(field)
    assert entry is not None, "another client has just set it"
    return entry

"""A caller's library: entries made, changed, taken out."""

from __future__ import annotations

import math
from collections.abc import Mapping

from regnf_core.library_entries import EntryNotes
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.ownership import reference_of
from regnf_state.record_store import LibraryEntry
from regnf_state.records import FieldRecord

# What a caller's work may cost the workers in an hour.

_WINDOW_MINUTES = 60


def check_budget(services: Services, caller: str) -> None:
    """Refuse new work of a caller whose work of the last hour has used up the budget.

    Measured seconds count, of failed work too. Raises Problem QUOTA_WORKER_SECONDS.
    """
    budget = services.settings.quota_worker_seconds_per_hour
    if budget is None:
        return
    wait_s = seconds_until_free(services.queue.spent(caller), budget, services.records.now())
    if wait_s:
        raise Problem("QUOTA_WORKER_SECONDS", headers={"Retry-After": str(wait_s)})


def seconds_until_free(spent: Mapping[int, float], budget: float, now: float) -> int:
    """When enough of what was spent is an hour ago, whole seconds from now; 0: now."""
    total = sum(spent.values())
    for minute, seconds in sorted(spent.items()):
        if total < budget:
            break
        total -= seconds
        free_at = (minute + _WINDOW_MINUTES) * 60
        if total < budget:
            return max(1, math.ceil(free_at - now))
    return 0


def find_entry(services: Services, caller: str, name: str) -> LibraryEntry:
    """Raises Problem LIBRARY_ENTRY_NOT_FOUND."""
    (entry,) = services.records.entries_named(caller, [name])
    if entry is None:
        raise Problem("LIBRARY_ENTRY_NOT_FOUND")
    return entry


def add_entry(services: Services, caller: str, sha256: str, notes: EntryNotes) -> tuple[LibraryEntry, bool]:
    """The entry, and whether it is new. Raises Problem FIELD_NOT_FOUND, FIELD_REJECTED, FIELD_IN_LIBRARY,
    QUOTA_WORKER_SECONDS, NameTakenError."""
    field = services.records.get_field(reference_of(caller, sha256))
    if field is None:
        raise Problem("FIELD_NOT_FOUND")
    if field.state == "rejected":
        raise Problem("FIELD_REJECTED")
    held = LibraryEntry.of(field)
    if held is not None and held.notes == notes:
        return held, False
    if held is not None:
        raise Problem("FIELD_IN_LIBRARY")
    check_budget(services, caller)
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
    assert entry is not None, "it was set a moment ago"
    return entry

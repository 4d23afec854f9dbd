"""The fields that a request means when it names entries of the caller's library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from regnf_service.http.schemas.library import MAX_SELECTED, LibraryFilter, LibraryReference, LibrarySelection
from regnf_service.problem import MAX_ERRORS, Problem
from regnf_service.services import Services
from regnf_state.ownership import sha256_of
from regnf_state.pages import Page, Position, all_of
from regnf_state.records import FieldRecord

_PAGE = 1000


def objects_meant(
    services: Services,
    caller: str,
    object_: str | LibraryReference | None,
    candidates: list[str] | LibrarySelection | None,
) -> tuple[str | None, list[str] | None]:
    """The SHA-256s that a request means. Raises Problem LIBRARY_ENTRY_NOT_FOUND, LIBRARY_EMPTY, LIBRARY_TOO_LARGE."""
    if isinstance(object_, LibraryReference):
        (object_,) = _named(services, caller, {"/object/library": object_.library})
    if isinstance(candidates, LibrarySelection):
        candidates = _selected(services, caller, candidates.library)
    return object_, candidates


def _selected(services: Services, caller: str, wanted: LibraryFilter) -> list[str]:
    named = {f"/candidates/library/names/{place}": name for place, name in enumerate(wanted.names or ())}
    found = _named(services, caller, named)
    if wanted.tags is not None or wanted.names is None:
        found += _tagged(services, caller, wanted.tags)
    meant = list(dict.fromkeys(found))
    if not meant:
        raise Problem("LIBRARY_EMPTY", errors=[{"pointer": "/candidates/library", "detail": "no entry is meant"}])
    if len(meant) > MAX_SELECTED:
        raise Problem("LIBRARY_TOO_LARGE", f"{len(meant)} entries are meant; one search takes {MAX_SELECTED}.")
    return meant


def _named(services: Services, caller: str, names: Mapping[str, str]) -> list[str]:
    """SHA-256 of each entry's field; ``names`` by the places where the request has them."""
    found = services.records.entries_named(caller, list(names.values()))
    missing = [pointer for pointer, entry in zip(names, found, strict=True) if entry is None]
    if missing:
        faults = [{"pointer": pointer, "detail": "no such entry"} for pointer in missing[:MAX_ERRORS]]
        raise Problem("LIBRARY_ENTRY_NOT_FOUND", errors=faults)
    rejected = [p for p, entry in zip(names, found, strict=True) if entry and entry.field.state == "rejected"]
    if rejected:
        raise Problem("FIELD_REJECTED", errors=[{"pointer": p, "detail": "rejected"} for p in rejected[:MAX_ERRORS]])
    return [sha256_of(entry.field.sha256) for entry in found if entry is not None]


def _tagged(services: Services, caller: str, tags: Sequence[str] | None) -> list[str]:
    """SHA-256 of the fields of all entries with any of the tags; None: of all. Rejected ones are left out."""

    def page(before: Position | None) -> Page[FieldRecord]:
        return services.records.list_entries(caller, None, None, _PAGE, before)

    entries = [(field, field.library) for field in all_of(page) if field.state != "rejected"]
    return [
        sha256_of(field.sha256)
        for field, said in entries
        if said is not None and (tags is None or not set(tags).isdisjoint(said["tags"]))
    ]

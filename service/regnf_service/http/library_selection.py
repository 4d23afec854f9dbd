"""The fields that requests mean when they name entries of their caller's library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from regnf_service.http.schemas.library import MAX_SELECTED, LibraryFilter, LibraryReference, LibrarySelection
from regnf_service.problem import MAX_ERRORS, Problem
from regnf_service.services import Services
from regnf_state.ownership import sha256_of
from regnf_state.pages import Page, Position, all_of
from regnf_state.records import FieldRecord

_PAGE = 1000


class _Entry(NamedTuple):
    """sha256: of its field."""

    sha256: str
    is_rejected: bool


class CallersLibrary:
    """The entries of one caller, each looked up once, however many requests name them. For one call or batch."""

    def __init__(self, services: Services, caller: str) -> None:
        self._services = services
        self._caller = caller
        self._by_name: dict[str, _Entry | None] = {}
        self._by_tags: dict[frozenset[str] | None, list[str]] = {}
        self._all: list[tuple[str, frozenset[str]]] | None = None

    def objects_meant(
        self, object_: str | LibraryReference | None, candidates: list[str] | LibrarySelection | None
    ) -> tuple[str | None, list[str] | None]:
        """The SHA-256s that a request means. Raises Problem LIBRARY_ENTRY_NOT_FOUND, LIBRARY_EMPTY, LIBRARY_TOO_LARGE,
        FIELD_REJECTED."""
        if isinstance(object_, LibraryReference):
            (object_,) = self._named({"/object/library": object_.library})
        if isinstance(candidates, LibrarySelection):
            candidates = self._selected(candidates.library)
        return object_, candidates

    def _selected(self, wanted: LibraryFilter) -> list[str]:
        found = self._named(
            {f"/candidates/library/names/{place}": name for place, name in enumerate(wanted.names or ())}
        )
        if wanted.tags is not None or wanted.names is None:
            found = found + self._tagged(wanted.tags)
        meant = list(dict.fromkeys(found))
        if not meant:
            raise Problem("LIBRARY_EMPTY", errors=[{"pointer": "/candidates/library", "detail": "no entry is meant"}])
        if len(meant) > MAX_SELECTED:
            raise Problem("LIBRARY_TOO_LARGE", f"{len(meant)} entries are meant; one search takes {MAX_SELECTED}.")
        return meant

    def _named(self, names: Mapping[str, str]) -> list[str]:
        """SHA-256 of each entry's field; ``names`` by the places where the request has them."""
        new = [name for name in dict.fromkeys(names.values()) if name not in self._by_name]
        if new:
            entries = self._services.records.entries_named(self._caller, new)
            held = [
                None if one is None else _Entry(sha256_of(one.field.sha256), one.field.state == "rejected")
                for one in entries
            ]
            self._by_name.update(zip(new, held, strict=True))
        found = {pointer: self._by_name[name] for pointer, name in names.items()}
        missing = [pointer for pointer, entry in found.items() if entry is None]
        if missing:
            faults = [{"pointer": pointer, "detail": "no such entry"} for pointer in missing[:MAX_ERRORS]]
            raise Problem("LIBRARY_ENTRY_NOT_FOUND", errors=faults)
        rejected = [pointer for pointer, entry in found.items() if entry and entry.is_rejected]
        if rejected:
            faults = [{"pointer": pointer, "detail": "rejected"} for pointer in rejected[:MAX_ERRORS]]
            raise Problem("FIELD_REJECTED", errors=faults)
        return [entry.sha256 for entry in found.values() if entry is not None]

    def _tagged(self, tags: Sequence[str] | None) -> list[str]:
        """SHA-256 of the fields of all entries with any of the tags; None: of all. Rejected ones are left out."""
        wanted = None if tags is None else frozenset(tags)
        if wanted not in self._by_tags:
            self._by_tags[wanted] = [sha256 for sha256, has in self._entries() if wanted is None or wanted & has]
        return self._by_tags[wanted]

    def _entries(self) -> list[tuple[str, frozenset[str]]]:
        if self._all is None:

            def page(before: Position | None) -> Page[FieldRecord]:
                return self._services.records.list_entries(self._caller, None, None, _PAGE, before)

            self._all = [
                (sha256_of(field.sha256), frozenset(field.library["tags"]))
                for field in all_of(page)
                if field.state != "rejected" and field.library is not None
            ]
        return self._all

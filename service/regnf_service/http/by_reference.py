"""A registration request whose fields are named, by their digests or as entries of the caller's library."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from regnf_service.concurrency import in_thread
from regnf_service.http.schemas.library import MAX_SELECTED, LibraryFilter, LibraryReference, LibrarySelection
from regnf_service.http.schemas.registrations import RegisterRequest
from regnf_service.problem import MAX_ERRORS, Problem
from regnf_service.services import Services
from regnf_state.library import LibraryEntry
from regnf_state.ownership import sha256_of
from regnf_state.pages import LOOKED_AT, Position
from regnf_state.registration_request import RegistrationRequest


class Library:
    """A caller's library as one request sees it: what it names is read once, however often. Blocking."""

    def __init__(self, services: Services, caller: str) -> None:
        self._records = services.records
        self._caller = caller
        self._named: dict[str, LibraryEntry | None] = {}
        self._usable: list[tuple[str, frozenset[str]]] = []
        self._rest: Position | None = None
        self._is_read = False

    def one(self, name: str, pointer: str) -> str:
        """SHA-256 of the entry's field. Raises as ``selected``."""
        return self._by_name({pointer: name})[0]

    def selected(self, wanted: LibraryFilter) -> list[str]:
        """SHA-256s of the fields that are meant.

        Raises Problem LIBRARY_ENTRY_NOT_FOUND, FIELD_REJECTED, LIBRARY_EMPTY, LIBRARY_TOO_LARGE.
        """
        found = self._by_name({f"/candidates/library/names/{n}": name for n, name in enumerate(wanted.names or ())})
        if wanted.tags is not None or wanted.names is None:
            found += self._by_tags(wanted.tags)
        meant = list(dict.fromkeys(found))
        if not meant:
            raise Problem("LIBRARY_EMPTY", errors=[{"pointer": "/candidates/library", "detail": "no entry is meant"}])
        if len(meant) > MAX_SELECTED:
            raise Problem(
                "LIBRARY_TOO_LARGE", f"The request names {len(meant)} entries; one search takes {MAX_SELECTED} at most."
            )
        return meant

    def _by_name(self, names: Mapping[str, str]) -> list[str]:
        """Of each entry; ``names`` by the places where the request has them."""
        new = [name for name in dict.fromkeys(names.values()) if name not in self._named]
        if new:
            self._named |= zip(new, self._records.entries_named(self._caller, new), strict=True)
        found = {pointer: self._named[name] for pointer, name in names.items()}
        missing = [pointer for pointer, entry in found.items() if entry is None]
        if missing:
            faults = [{"pointer": pointer, "detail": "no such entry"} for pointer in missing[:MAX_ERRORS]]
            raise Problem("LIBRARY_ENTRY_NOT_FOUND", errors=faults)
        rejected = [pointer for pointer, entry in found.items() if entry and entry.field.state == "rejected"]
        if rejected:
            faults = [{"pointer": pointer, "detail": "rejected"} for pointer in rejected[:MAX_ERRORS]]
            raise Problem("FIELD_REJECTED", errors=faults)
        return [sha256_of(entry.field.sha256) for entry in found.values() if entry is not None]

    def _by_tags(self, tags: Sequence[str] | None) -> list[str]:
        """Of all entries with any of the tags; None: of all. Rejected ones are left out."""
        while self.read_more():
            pass
        return [sha256 for sha256, has in self._usable if tags is None or not has.isdisjoint(tags)]

    def read_more(self) -> bool:
        """Read a page of the entries that tags are looked for among: whether another follows."""
        if not self._is_read:
            page = self._records.list_entries(self._caller, None, None, LOOKED_AT, self._rest)
            self._usable += [
                (sha256_of(field.sha256), frozenset(field.library["tags"]))
                for field in page.records
                if field.state != "rejected" and field.library is not None
            ]
            self._rest, self._is_read = page.rest, page.rest is None
        return not self._is_read


async def read_library(library: Library, specs: Iterable[RegisterRequest]) -> None:
    """Read what these requests select by tag, a page at a time: other callers' requests go on in between."""
    selected = [spec.candidates.library for spec in specs if isinstance(spec.candidates, LibrarySelection)]
    if any(wanted.tags is not None or wanted.names is None for wanted in selected):
        while await in_thread(library.read_more):
            pass


def asked_by_reference(library: Library, spec: RegisterRequest) -> tuple[RegistrationRequest, dict[str, str]]:
    """The job's request, and the fields that the caller must have beside the scene's, by where they are named.

    Raises Problem LIBRARY_ENTRY_NOT_FOUND, FIELD_REJECTED, LIBRARY_EMPTY, LIBRARY_TOO_LARGE.
    """
    object_, candidates = spec.object, spec.candidates
    if isinstance(object_, LibraryReference):
        object_ = library.one(object_.library, "/object/library")
    named = {"/scene": spec.scene}
    if object_ is not None:
        named["/object"] = object_
    if isinstance(candidates, LibrarySelection):
        candidates = library.selected(candidates.library)  # they are there
    else:
        named |= {f"/candidates/{place}": sha256 for place, sha256 in enumerate(candidates or ())}
    return spec.to_request(spec.scene, object_, candidates), named

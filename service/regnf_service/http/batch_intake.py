"""Taking a batch in: each line is read by itself, and what is wrong with one refuses no other."""

from __future__ import annotations

import codecs
import hashlib
import json
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from regnf_core.texts import TextError, TextStream
from regnf_core.version import ENGINE_REVISION
from regnf_service.batches import Line, Posting
from regnf_service.concurrency import in_thread
from regnf_service.http.schemas.batches import BatchPair
from regnf_service.http.schemas.library import MAX_SELECTED, LibraryFilter, LibraryReference, LibrarySelection
from regnf_service.http.schemas.reading import read_model
from regnf_service.http.schemas.registrations import RegisterRequest
from regnf_service.problem import MAX_ERRORS, Problem
from regnf_service.services import Services
from regnf_state.ownership import sha256_of
from regnf_state.record_store import LOOKED_AT, LibraryEntry, Position
from regnf_state.registration_request import RegistrationRequest

# A streamed body as lines, each of a bounded size.

LINE_BYTES = 64 * 1024
"""A search among 512 candidates takes 35,000."""


class TextLine(NamedTuple):
    """One line that is not blank. number: in the body, from 1 on · text: None for one that is too long."""

    number: int
    text: bytes | None


class LineReader:
    """Cuts what it is fed into lines. It keeps one line at most, and of one that is too long nothing."""

    def __init__(self, most_bytes: int = LINE_BYTES) -> None:
        self._most = most_bytes
        self._held = bytearray()
        self._is_too_long = False
        self._number = 0

    def feed(self, data: bytes) -> list[TextLine]:
        """The lines that end in ``data``."""
        *ended, rest = data.split(b"\n")
        lines = [line for part in ended if (line := self._end(part)) is not None]
        self._add(rest)
        return lines

    def finish(self) -> list[TextLine]:
        """The last line, where no line feed ends it."""
        last = self._end(b"")
        return [] if last is None else [last]

    def _add(self, part: bytes) -> None:
        if self._is_too_long or len(self._held) + len(part) > self._most:
            self._is_too_long = True
            self._held.clear()
        else:
            self._held += part

    def _end(self, part: bytes) -> TextLine | None:
        self._add(part)
        self._number += 1
        text, too_long = bytes(self._held).strip().lstrip(codecs.BOM_UTF8), self._is_too_long
        self._held.clear()
        self._is_too_long = False
        if too_long:
            return TextLine(self._number, None)
        return TextLine(self._number, text) if text else None


async def lines_of(chunks: AsyncIterator[bytes]) -> AsyncIterator[list[TextLine]]:
    """The lines of a body in any encoding, as many at a time as arrive together. Raises Problem MALFORMED_JSON."""
    reader, text = LineReader(), TextStream()
    try:
        async for data in chunks:
            if lines := reader.feed(text.feed(data)):
                yield lines
        if lines := reader.feed(text.feed(b"", final=True)) + reader.finish():
            yield lines
    except TextError as error:
        raise Problem("MALFORMED_JSON", f"The body is {error}.", hint="Save it as UTF-8.") from error


# A registration request whose fields are named, by their digests or as entries of the caller's library.


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
            raise Problem(
                "LIBRARY_EMPTY", errors=[{"pointer": "/candidates/library", "detail": "no entry is selected"}]
            )
        if len(meant) > MAX_SELECTED:
            raise Problem(
                "LIBRARY_TOO_LARGE",
                f"The request selects {len(meant)} entries; one search can have at most {MAX_SELECTED}.",
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


_ID_DIGITS = 32
Read = tuple[Line, TextLine, BatchPair | None]


class Intake:
    """Reads the lines of one batch. Blocking: ``read`` needs no store, ``take`` does. The library is looked up once."""

    def __init__(self, services: Services, caller: str) -> None:
        self._services = services
        self._caller = caller
        self.library = Library(services, caller)
        self._lines: list[Line] = []
        self._keys: dict[str, int] = {}
        self._count = 0
        self._identity = hashlib.sha256(f"batch {ENGINE_REVISION} {caller}\n".encode())

    def read(self, texts: Sequence[TextLine]) -> list[Read]:
        """These lines as requests; with an error those that are none. Raises Problem REQUEST_TOO_LARGE."""
        most = self._services.settings.max_batch_pairs
        self._count += len(texts)
        if self._count > most:
            extra = {"fitting_lines": most}
            raise Problem("REQUEST_TOO_LARGE", f"A batch can have at most {most} lines.", extra=extra)
        return [self._read(text) for text in texts]

    def take(self, read: Sequence[Read]) -> None:
        """Find the objects that the requests mean, and keep the lines."""
        for line, text, spec in read:
            if spec is not None:
                try:
                    line.asked, line.named = asked_by_reference(self.library, spec)
                except Problem as problem:
                    line.error = problem.document()
            if line.asked is not None:
                self._identify([line.key, line.asked.values()])
            else:
                self._identify([hashlib.sha256(text.text or b"").hexdigest(), (line.error or {}).get("reason")])
            self._lines.append(line)

    def finish(self) -> Posting:
        """All lines, to become jobs. Raises Problem INVALID_REQUEST."""
        if not self._lines:
            raise Problem("INVALID_REQUEST", "The body has no lines. Send one request per line.")
        return Posting(self._services, self._caller, self._identity.hexdigest()[:_ID_DIGITS], self._lines)

    def _read(self, text: TextLine) -> Read:
        line = Line(text.number)
        try:
            spec = self._spec(text)
        except Problem as problem:
            line.error = problem.document()
            return line, text, None
        line.key = spec.key
        return line, text, spec

    def _spec(self, text: TextLine) -> BatchPair:
        """Raises Problem: what POST /register would say."""
        if text.text is None:
            raise Problem("REQUEST_TOO_LARGE", f"A line can have at most {LINE_BYTES} bytes.")
        spec = read_model(BatchPair, text.text)
        if spec.key is not None and self._keys.setdefault(spec.key, text.number) != text.number:
            fault = {"pointer": "/key", "detail": f"Line {self._keys[spec.key]} has the same key."}
            raise Problem("INVALID_REQUEST", errors=[fault])
        return spec

    def _identify(self, value: Any) -> None:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
        self._identity.update(text.encode() + b"\n")

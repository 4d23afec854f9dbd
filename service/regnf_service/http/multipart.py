"""multipart/form-data read as a stream: text parts into memory, file parts straight to where they go.

The framework's own form parser spools files to a temporary folder first; a scene of gigabytes must not pass through it.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from email.message import Message
from typing import Protocol

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser
from starlette.requests import Request

from regnf_service.concurrency import PARSING
from regnf_service.problem import CLOSE, Problem

_MAX_HEADER_BYTES = 4096
_MAX_PARAMETERS = 64
"""Of a header. The library that reads them takes time that grows with the square of their number."""
_MAX_HEADERS = 8


class Sink(Protocol):
    """Where a file part's bytes go."""

    def begin(self, filename: str) -> None:
        """The part has come, under this name; "" for none."""
        ...

    async def feed(self, data: bytes | bytearray) -> None: ...


class _Part:
    """One part: its name, and its text if it is no file."""

    def __init__(self) -> None:
        self.headers: dict[str, str] = {}
        self.name = ""
        self.filename = ""
        self.text = bytearray()


class _Collector:
    """Turns the parser's callbacks into a list of (part, bytes): None for a part's beginning."""

    def __init__(self, boundary: str) -> None:
        self.events: list[tuple[_Part, bytearray | None]] = []
        self.ended = False
        self._part = _Part()
        self._field = bytearray()
        self._value = bytearray()
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin,
                "on_part_data": self._data,
                "on_header_field": lambda data, start, end: self._field.extend(data[start:end]),
                "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
                "on_header_end": self._header,
                "on_headers_finished": lambda: self.events.append((self._part, None)),
                "on_end": self._end,
            },
            max_header_count=_MAX_HEADERS,
            max_header_size=_MAX_HEADER_BYTES,
        )

    def _begin(self) -> None:
        self._part = _Part()

    def _data(self, data: bytes, start: int, end: int) -> None:
        """Joined with what came just before: nearly a boundary in every line would make an event of every few bytes."""
        if self.events and isinstance(known := self.events[-1][1], bytearray):
            known += data[start:end]
        else:
            self.events.append((self._part, bytearray(data[start:end])))

    def _end(self) -> None:
        self.ended = True

    def _header(self) -> None:
        name = self._field.decode("latin-1").lower()
        self._part.headers[name] = self._value.decode("latin-1")
        self._field.clear()
        self._value.clear()
        if name == "content-disposition":
            self._part.name = _parameter(self._part.headers[name], "name") or ""
            self._part.filename = _parameter(self._part.headers[name], "filename") or ""

    def feed(self, data: bytes) -> list[tuple[_Part, bytearray | None]]:
        self._parser.write(data)
        events, self.events = self.events, []
        return events


def _parameter(header: str, name: str) -> str | None:
    """One parameter of a structured header such as Content-Disposition or Content-Type; None where there are many."""
    if header.count(";") > _MAX_PARAMETERS:
        return None
    message = Message()
    message["content-type"] = header.replace("\r", " ").replace("\n", " ")
    try:
        value = message.get_param(name)
    except ValueError:  # a continuation (RFC 2231) numbered with more digits than an integer may have
        return None
    return value if isinstance(value, str) else None


def boundary_of(request: Request) -> str:
    """The boundary that the Content-Type announces. Raises Problem MALFORMED_MULTIPART."""
    boundary = _parameter(request.headers.get("content-type", ""), "boundary")
    if not boundary or not boundary.isascii() or len(boundary) > 70:
        raise Problem("MALFORMED_MULTIPART", "The Content-Type names no usable boundary.", headers=CLOSE)
    return boundary


async def read_parts(
    body: AsyncIterator[bytes],
    boundary: str,
    files: Mapping[str, Sink],
    texts: Mapping[str, int],
) -> dict[str, bytes]:
    """Feed the parts named in ``files`` to their sinks; return the text parts, capped as ``texts`` says, by name.

    A file part that came appears in the answer too, empty. Looking for boundaries takes long where there is nearly one
    in every line, so it is done in a thread, a piece at a time.

    Raises Problem: MALFORMED_MULTIPART, UNKNOWN_PART, DUPLICATE_PART, REQUEST_TOO_LARGE, and what the sinks raise.
    """
    collector = _Collector(boundary)
    parts: dict[str, _Part] = {}
    async for data in body:
        try:
            events = await PARSING.run(collector.feed, data)
        except FormParserError as error:
            raise Problem("MALFORMED_MULTIPART", headers=CLOSE) from error
        for part, content in events:
            if content is None:
                _admit(part, parts, files, texts)
            elif part.name in files:
                await files[part.name].feed(content)
            else:
                _add_text(part, content, texts[part.name])
    if not collector.ended:
        raise Problem("MALFORMED_MULTIPART", "The body ends before its closing boundary.", headers=CLOSE)
    return {name: bytes(part.text) for name, part in parts.items()}


def _admit(part: _Part, parts: dict[str, _Part], files: Mapping[str, Sink], texts: Mapping[str, int]) -> None:
    if part.name not in files and part.name not in texts:
        raise Problem("UNKNOWN_PART", f"Known parts: {', '.join([*files, *texts])}.", headers=CLOSE)
    if part.name in parts:
        raise Problem("DUPLICATE_PART", headers=CLOSE)
    if part.headers.get("content-transfer-encoding", "binary").lower() not in ("binary", "8bit", "7bit"):
        raise Problem("MALFORMED_MULTIPART", "Content-Transfer-Encoding is not taken.", headers=CLOSE)
    parts[part.name] = part
    if part.name in files:
        files[part.name].begin(part.filename)


def _add_text(part: _Part, content: bytearray, limit: int) -> None:
    if len(part.text) + len(content) > limit:
        raise Problem("REQUEST_TOO_LARGE", f"The part {part.name} takes at most {limit} bytes.", headers=CLOSE)
    part.text += content

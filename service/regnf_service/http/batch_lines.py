"""A streamed body as lines, each of a bounded size."""

from __future__ import annotations

import codecs
from collections.abc import AsyncIterator
from typing import NamedTuple

from regnf_core.texts import TextError, TextStream
from regnf_service.problem import CLOSE, Problem

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
        raise Problem("MALFORMED_JSON", f"The body is {error}.", hint="Save it as UTF-8.", headers=CLOSE) from error

"""MessagePack by its published specification, bounded in number and depth of values; binaries are not copied.

Libraries for it bound the length of each list, but not the memory of all values together.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

from regnf_core.errors import FieldFormatError

_MOST_VALUES, _DEEPEST = 2_000_000, 32
"""A snapshot with two thousand cameras has a tenth of them."""
_WORDS = {0xC0: None, 0xC2: False, 0xC3: True}
_NUMBERS = {
    **dict(zip((0xCA, 0xCB, 0xCC, 0xCD, 0xCE, 0xCF), (">f", ">d", ">B", ">H", ">I", ">Q"), strict=True)),
    **dict(zip((0xD0, 0xD1, 0xD2, 0xD3), (">b", ">h", ">i", ">q"), strict=True)),
}
_LENGTHS = {
    **dict(zip((0xC4, 0xC5, 0xC6), ((">B", "bin"), (">H", "bin"), (">I", "bin")), strict=True)),
    **dict(zip((0xC7, 0xC8, 0xC9), ((">B", "ext"), (">H", "ext"), (">I", "ext")), strict=True)),
    **dict(zip((0xD9, 0xDA, 0xDB), ((">B", "str"), (">H", "str"), (">I", "str")), strict=True)),
    **dict(zip((0xDC, 0xDD, 0xDE, 0xDF), ((">H", "list"), (">I", "list"), (">H", "map"), (">I", "map")), strict=True)),
}
_FIXED_EXT = {0xD4: 1, 0xD5: 2, 0xD6: 4, 0xD7: 8, 0xD8: 16}
_GZIP = b"\x1f\x8b"
_RATIO, _FREE = 200, 64 << 20
"""Unpacked bytes: so many times the packed ones, beyond those that are allowed in any case."""


def unpacked(data: memoryview, most: int) -> memoryview:
    """``data`` itself, or what is in it if it is packed by gzip: ``most`` bytes at most.

    Raises FieldFormatError: ARCHIVE_TOO_LARGE, FORMAT_NOT_SUPPORTED for a damaged file, FILE_TRUNCATED.
    """
    if bytes(data[:2]) != _GZIP:
        return data
    stream, allowed = zlib.decompressobj(31), min(most, max(_FREE, _RATIO * len(data)))
    try:
        found = stream.decompress(data, allowed)
    except zlib.error as error:
        raise _malformed("the packed file is damaged") from error
    if stream.unconsumed_tail:
        message = f"the file has more than {allowed >> 20} MiB when it is unpacked"
        raise FieldFormatError(message, reason="ARCHIVE_TOO_LARGE")
    if not stream.eof:
        raise FieldFormatError("the packed file ends too early", reason="FILE_TRUNCATED")
    return memoryview(found)


def read_msgpack(data: memoryview) -> Any:
    """The one value in ``data``; binaries and extensions as memoryviews.

    Raises FieldFormatError: FILE_TRUNCATED, FORMAT_NOT_SUPPORTED for a malformed file or one with too many values.
    """
    reader = _Reader(data)
    value = reader.value(0)
    if reader.at != len(data):
        raise _malformed("there is data after the end of the values")
    return value


class _Reader:
    """Reads from left to right; ``at`` is where it is."""

    def __init__(self, data: memoryview) -> None:
        self.at, self._data, self._left = 0, data, _MOST_VALUES

    def value(self, depth: int) -> Any:
        self._left -= 1
        if self._left < 0 or depth > _DEEPEST:
            raise _malformed(f"more than {_MOST_VALUES} values, or values nested more than {_DEEPEST} deep")
        first = self._taken(1)[0]
        if first <= 0x7F:
            return first
        if first >= 0xE0:
            return first - 0x100
        if first in _WORDS:
            return _WORDS[first]
        if first in _NUMBERS:
            return self._number(_NUMBERS[first])
        return self._sized(*self._size(first), depth)

    def _size(self, first: int) -> tuple[int, str]:
        """How long what follows is, and what it is."""
        for low, most, kind in ((0x80, 0x8F, "map"), (0x90, 0x9F, "list"), (0xA0, 0xBF, "str")):
            if low <= first <= most:
                return first - low, kind
        if first in _FIXED_EXT:
            return _FIXED_EXT[first], "ext"
        if first not in _LENGTHS:
            raise _malformed("a byte that begins no value")
        form, kind = _LENGTHS[first]
        return self._number(form), kind

    def _sized(self, size: int, kind: str, depth: int) -> Any:
        if kind == "list":
            return [self.value(depth + 1) for _ in range(size)]
        if kind == "map":
            found = {}
            for _ in range(size):
                key = self.value(depth + 1)
                if not isinstance(key, str) or key in found:
                    raise _malformed("a key is no text, or occurs twice")
                found[key] = self.value(depth + 1)
            return found
        if kind == "ext":
            self._taken(1)
        taken = self._taken(size)
        try:
            return str(taken, "utf-8") if kind == "str" else taken
        except UnicodeDecodeError as error:
            raise _malformed("a text is not UTF-8") from error

    def _number(self, form: str) -> Any:
        return struct.unpack(form, self._taken(struct.calcsize(form)))[0]

    def _taken(self, size: int) -> memoryview:
        taken = self._data[self.at : self.at + size]
        if len(taken) < size:
            raise FieldFormatError("the file ends within a value", reason="FILE_TRUNCATED")
        self.at += size
        return taken


def _malformed(what: str) -> FieldFormatError:
    return FieldFormatError(f"not a valid MessagePack file: {what}", reason="FORMAT_NOT_SUPPORTED")

"""A bounded cursor over pickle bytes: every read checks what is left, and how much one value may take."""

from __future__ import annotations

from regnf_core.errors import FieldFormatError

MAX_STRING_BYTES = 8 * 1024 * 1024
MAX_INTEGER_BYTES = 32
_MAX_LINE_BYTES = 512


def pickle_error(message: str, reason: str = "PICKLE_MALFORMED") -> FieldFormatError:
    """The error for a fault in the pickle."""
    return FieldFormatError(message, reason=reason)


class PickleStream:
    """Reads little-endian numbers, strings and lines. ``position`` counts bytes from the pickle's start."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self.position = 0

    @property
    def remaining(self) -> int:
        return len(self._data) - self.position

    def take(self, count: int) -> memoryview:
        """The next ``count`` bytes."""
        if count > self.remaining:
            raise pickle_error("the pickle ends in the middle of a value")
        start = self.position
        self.position += count
        return self._data[start : self.position]

    def byte(self) -> int:
        return self.take(1)[0]

    def unsigned(self, size: int) -> int:
        """An unsigned integer of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def integer(self, size: int) -> int:
        """A two's complement integer of ``size`` bytes; 0 bytes are 0."""
        if size > MAX_INTEGER_BYTES:
            raise pickle_error(f"an integer of {size} bytes", "PICKLE_INTEGER_TOO_LARGE")
        return int.from_bytes(self.take(size), "little", signed=True)

    def blob(self, length_size: int) -> bytes:
        """Bytes behind a length of ``length_size`` bytes."""
        length = self.unsigned(length_size)
        if length > MAX_STRING_BYTES:
            raise pickle_error(f"a string of {length} bytes", "PICKLE_STRING_TOO_LARGE")
        return bytes(self.take(length))

    def text(self, length_size: int) -> str:
        """UTF-8 text behind a length of ``length_size`` bytes; lone surrogates are kept, as Python writes them."""
        try:
            return self.blob(length_size).decode("utf-8", "surrogatepass")
        except UnicodeDecodeError as error:
            raise pickle_error("a string is not UTF-8") from error

    def line(self) -> str:
        """A printable ASCII line up to, without, its newline."""
        window = bytes(self._data[self.position : self.position + _MAX_LINE_BYTES])
        end = window.find(b"\n")
        if end < 0 or not all(0x20 < char < 0x7F for char in window[:end]):
            raise pickle_error("a global's name is not a line of plain text")
        self.position += end + 1
        return window[:end].decode("ascii")

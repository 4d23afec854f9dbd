"""A run in a tar file, plain or packed. It is read from first to last, once for the names and once for the contents."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from regnf_core.errors import FieldFormatError
from regnf_core.importing.run.byte_stream import ByteStream, MappedBytes, UnpackedBytes
from regnf_core.importing.run.tar_headers import TarMember, padding_of, tar_members
from regnf_core.importing.run.unpacking import archive_error, kept, require_modest


class TarRun:
    """The members of one tar file by name. packing: gzip, bzip2, xz or None. ``most`` caps the bytes unpacked."""

    def __init__(self, data: memoryview, packing: str | None, most: int) -> None:
        self._data, self._packing, self._most = data, packing, most
        self.sizes: dict[str, int] = {}
        """Each member's size in bytes."""
        stream = self._stream()
        for member in _members(stream, packing):
            for _ in stream.pieces(member.size + padding_of(member.size)):
                pass
            self.sizes[member.name] = member.size

    def take(self, names: Collection[str], folder: Path) -> dict[str, memoryview]:
        """The members of these names. Raises FieldFormatError (ARCHIVE_TOO_LARGE)."""
        require_modest(sum(self.sizes[name] for name in names), len(self._data), self._most)
        stream, taken = self._stream(), {}
        for member in tar_members(stream):
            pieces = stream.pieces(member.size)
            if member.name in names:
                taken[member.name] = _content(pieces, member.size, folder)
            else:
                for _ in pieces:
                    pass
            for _ in stream.pieces(padding_of(member.size)):
                pass
            if len(taken) == len(names):
                return taken
        raise archive_error("the archive reads otherwise the second time")

    def _stream(self) -> ByteStream:
        if self._packing is None:
            return MappedBytes(self._data)
        return UnpackedBytes(self._data, self._packing, self._most)


def _members(stream: ByteStream, packing: str | None) -> Iterator[TarMember]:
    """The members; what is packed and no archive at all is said to be so."""
    found = tar_members(stream)
    try:
        first = next(found, None)
    except FieldFormatError as error:
        if packing is None or error.reason != "ARCHIVE_MALFORMED":
            raise
        message = f"a single file packed by {packing}, or a damaged archive: unpack it, and give the file"
        raise error.told(message) from error
    if first is not None:
        yield first
        yield from found


def _content(pieces: Iterator[bytes | memoryview], size: int, folder: Path) -> memoryview:
    """A member of a map is a view of it; what comes in pieces is put together."""
    first = next(pieces, b"")
    if len(first) == size:
        return memoryview(first)
    return kept(_chained(first, pieces), size, folder)


def _chained(first: bytes | memoryview, rest: Iterator[bytes | memoryview]) -> Iterator[bytes | memoryview]:
    yield first
    yield from rest

"""Bytes from first to last, as a tar file is read: those of a map, or those that a packed file unpacks to."""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Iterator
from typing import Protocol

from regnf_core.errors import FieldFormatError
from regnf_core.importing.run.unpacking import archive_error, require_modest

_PIECE = 1 << 20
_XZ_MEMORY = 256 << 20


class ByteStream(Protocol):
    """Reads on and on; there is no way back."""

    def pieces(self, size: int) -> Iterator[bytes | memoryview]:
        """The next ``size`` bytes, in pieces. Raises FieldFormatError (FILE_TRUNCATED) where there are fewer."""
        ...

    def rest(self) -> Iterator[bytes | memoryview]:
        """All that is left, in pieces."""
        ...


class MappedBytes:
    """The bytes of a map; pieces are views of it."""

    def __init__(self, data: memoryview) -> None:
        self._data, self._at = data, 0

    def pieces(self, size: int) -> Iterator[memoryview]:
        """See :class:`ByteStream`. One piece."""
        if size > len(self._data) - self._at:
            raise truncated()
        self._at += size
        yield self._data[self._at - size : self._at]

    def rest(self) -> Iterator[memoryview]:
        """See :class:`ByteStream`."""
        return self.pieces(len(self._data) - self._at)


class UnpackedBytes:
    """What a gzip, bzip2 or xz file unpacks to, a piece at a time, ``most`` bytes at most."""

    def __init__(self, data: memoryview, packing: str, most: int) -> None:
        self._source = _unpacked(data, packing, most)
        self._waiting = memoryview(b"")

    def pieces(self, size: int) -> Iterator[memoryview]:
        """See :class:`ByteStream`."""
        while size:
            if not self._waiting:
                piece = next(self._source, None)
                if piece is None:
                    raise truncated()
                self._waiting = memoryview(piece)
            part, self._waiting = self._waiting[:size], self._waiting[size:]
            size -= len(part)
            yield part

    def rest(self) -> Iterator[memoryview]:
        """See :class:`ByteStream`."""
        yield self._waiting
        self._waiting = memoryview(b"")
        for piece in self._source:
            yield memoryview(piece)


def truncated() -> FieldFormatError:
    """The error for an archive that ends too early."""
    return FieldFormatError("the archive ends too early: the file was cut short", reason="FILE_TRUNCATED")


class _Gzip:
    """zlib's reader of gzip files in the manner of bz2's and lzma's."""

    def __init__(self) -> None:
        self._inflater = zlib.decompressobj(16 + zlib.MAX_WBITS)

    @property
    def eof(self) -> bool:
        """Whether the stream has ended."""
        return self._inflater.eof

    @property
    def needs_input(self) -> bool:
        """Whether nothing is left of what was given."""
        return not self._inflater.unconsumed_tail

    @property
    def unused_data(self) -> bytes:
        """What came behind the stream's end."""
        return self._inflater.unused_data

    def decompress(self, data: bytes | memoryview, max_length: int) -> bytes:
        """At most ``max_length`` bytes more."""
        return self._inflater.decompress(data or self._inflater.unconsumed_tail, max_length)


def _unpacker(packing: str) -> _Gzip | bz2.BZ2Decompressor | lzma.LZMADecompressor:
    if packing == "gzip":
        return _Gzip()
    return bz2.BZ2Decompressor() if packing == "bzip2" else lzma.LZMADecompressor(memlimit=_XZ_MEMORY)


def _unpacked(data: memoryview, packing: str, most: int) -> Iterator[bytes]:
    """One packed stream, piece by piece. Nothing may follow it."""
    unpacker, at, total = _unpacker(packing), 0, 0
    try:
        while not unpacker.eof:
            fresh: bytes | memoryview = b""
            if unpacker.needs_input:
                fresh = data[at : at + _PIECE]
                at += len(fresh)
                if not fresh:
                    raise truncated()
            piece = unpacker.decompress(fresh, _PIECE)
            total += len(piece)
            require_modest(total, at, most)
            if piece:
                yield piece
    except (zlib.error, OSError, EOFError, ValueError, lzma.LZMAError) as error:
        raise archive_error(f"the {packing} file is damaged") from error
    if at != len(data) or unpacker.unused_data:
        raise archive_error(f"something lies behind the {packing} file's end", "ARCHIVE_TRAILING_DATA")

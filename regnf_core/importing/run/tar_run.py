"""A run in a tar file, plain or packed. It is read from first to last, once for the names and once for the contents."""

from __future__ import annotations

import bz2
import itertools
import lzma
import mmap
import re
import zlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from regnf_core.errors import FieldFormatError

# Where an archive's members go as they are unpacked: small ones into memory, large ones into a file that is mapped.

MAX_NAME_BYTES, MAX_PARTS = 512, 32
FREE_BYTES = 64 << 20
"""What an archive may unpack to without anybody looking at how tightly it was packed."""
MAX_RATIO = 200
"""Beyond that, bytes unpacked for a byte packed. Checkpoints of trained fields stay below 10."""
_IN_MEMORY = 1 << 20


def archive_error(message: str, reason: str = "ARCHIVE_MALFORMED") -> FieldFormatError:
    """The error for an archive of a run that is not taken."""
    return FieldFormatError(message, reason=reason)


def require_modest(unpacked: int, packed: int, most: int) -> None:
    """Raise FieldFormatError (ARCHIVE_TOO_LARGE) for what unpacks to more than ``most`` bytes, or to many from few."""
    if unpacked > most:
        raise archive_error(f"the archive unpacks to more than {most} bytes", "ARCHIVE_TOO_LARGE")
    if unpacked > FREE_BYTES + MAX_RATIO * packed:
        raise archive_error(f"the archive unpacks to more than {MAX_RATIO} times its size", "ARCHIVE_TOO_LARGE")


def kept(pieces: Iterable[bytes | memoryview], size: int, folder: Path) -> memoryview:
    """The pieces, ``size`` bytes in all, in one. A large one lies in a new file in ``folder`` until that is removed."""
    if size <= _IN_MEMORY:
        return memoryview(b"".join(pieces))
    with open(new_file(folder), "x+b") as file:
        for piece in pieces:
            file.write(piece)
        file.flush()
        return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def new_file(folder: Path) -> Path:
    """Where the next part of an archive may be written."""
    return next(path for path in _places(folder) if not path.exists())


def remove_unpacked(folder: Path) -> None:
    """Remove the files that were written to ``new_file``. What is mapped stays readable."""
    for path in _places(folder):
        if not path.exists():
            return
        path.unlink()


def _places(folder: Path) -> Iterator[Path]:
    return (folder / f"unpacked-{number}" for number in itertools.count())


# Bytes from first to last, as a tar file is read: those of a map, or those that a packed file unpacks to.

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


# The headers of a tar file, decoded and checked: what a member is called, what it is, how long it is.

BLOCK = 512
_MAX_MEMBERS = 16_384
_MAX_RECORDS = 64 * 1024
_MAX_TAIL = 1 << 20
_PART = re.compile(r"[^\x00-\x1f\x7f/\\]+")
_MAX_NUMBER = 1 << 60
_FILE, _FOLDER, _LINKS = b"0\0", b"5", b"12"
_LONG_NAME, _LONG_LINK, _RECORDS, _SHARED_RECORDS = b"L", b"K", b"x", b"g"
_OLD_TORCH = frozenset({"sys_info", "pickle", "storages", "tensors"})


@dataclass(frozen=True)
class TarMember:
    """One plain file of a tar file."""

    name: str
    size: int


def tar_members(stream: ByteStream) -> Iterator[TarMember]:
    """The files of a tar file in order, folders left out. The caller reads each one's content, ``size`` bytes, from the
    stream before it goes on, and calls :func:`end_of` behind it.

    Raises FieldFormatError: FILE_TRUNCATED, LEGACY_TORCH_FILE and the ARCHIVE_* reasons of docs/import-gate.md.
    """
    seen: set[str] = set()
    for _ in range(_MAX_MEMBERS):
        found = _next_member(stream)
        if found is None:
            return
        name, is_folder, size = found
        if is_folder:
            continue
        if name in _OLD_TORCH:
            message = "a tar archive, as PyTorch wrote before version 0.1.10; save it again"
            raise archive_error(message, "LEGACY_TORCH_FILE")
        if name in seen:
            raise archive_error("two members share a name", "ARCHIVE_DUPLICATE_ENTRY")
        seen.add(name)
        yield TarMember(name, size)
    raise archive_error(f"more than {_MAX_MEMBERS} members", "ARCHIVE_TOO_MANY_ENTRIES")


def padding_of(size: int) -> int:
    """How many bytes lie between a member's content and the next header."""
    return -size % BLOCK


def _next_member(stream: ByteStream) -> tuple[str, bool, int] | None:
    """Name, whether it is a folder, and size of the next member, after the headers that only say more about it."""
    said: dict[str, str] = {}
    for _ in range(4):
        header = _bytes(stream, BLOCK)
        if not any(header):
            _require_end(stream)
            return None
        _check_sum(header)
        kind, size = header[156:157], _number(header[124:136])
        if kind in (_LONG_NAME, _RECORDS, _SHARED_RECORDS, _LONG_LINK):
            if size > _MAX_RECORDS:
                raise archive_error("a header says too much", "ARCHIVE_ENTRY_NAME")
            content = _bytes(stream, size)
            _bytes(stream, padding_of(size))
            said |= _records(content, kind)
            continue
        _require_plain(kind, said)
        name, size = said.get("path", _stored_name(header)), int(said.get("size", size))
        is_folder = kind == _FOLDER or (kind == b"\0" and name.endswith("/"))
        if is_folder and size:
            raise archive_error("a folder with a content")
        name = _checked_name(name)
        if name == "." and not is_folder:
            raise archive_error("a member without a name", "ARCHIVE_ENTRY_NAME")
        return name, is_folder, size
    raise archive_error("too many headers for one member")


def _require_plain(kind: bytes, said: dict[str, str]) -> None:
    if kind in (b"1", b"2"):
        message = "the archive holds a link; pack the run with what it leads to (tar --dereference)"
        raise archive_error(message, "ARCHIVE_LINK")
    if kind not in (b"0", b"\0", _FOLDER):
        raise archive_error(
            "the archive holds a device, a sparse file or something else than plain files", "ARCHIVE_SPECIAL_FILE"
        )
    if any(key.startswith("GNU.sparse") for key in said):
        raise archive_error("the archive holds a sparse file; pack it without --sparse", "ARCHIVE_SPECIAL_FILE")


def _records(content: bytes, kind: bytes) -> dict[str, str]:
    """What a header about the next member says of its name and size."""
    if kind == _LONG_LINK:
        return {}
    if kind == _LONG_NAME:
        return {"path": _text(content.rstrip(b"\0"))}
    found: dict[str, str] = {}
    at = 0
    while at < len(content):
        length, space, _ = content[at : at + 8].partition(b" ")
        end = at + int(length) if space and length.isdigit() else 0
        if not at + len(length) + 1 < end <= len(content) or content[end - 1 : end] != b"\n":
            raise archive_error("a header's records are malformed")
        key, equals, value = content[at + len(length) + 1 : end - 1].partition(b"=")
        if not equals:
            raise archive_error("a header's records are malformed")
        name = key.decode("latin-1")
        if name in ("path", "size") or name.startswith("GNU.sparse"):
            found[name] = _text(value)
        at = end
    if "size" in found and not (found["size"].isdigit() and len(found["size"]) < 19):
        raise archive_error("a member's size is no number")
    if kind == _SHARED_RECORDS:
        if found:
            raise archive_error("a header for all members names one")
        return {}
    return found


def _checked_name(name: str) -> str:
    """The name below the archive's folder. Raises FieldFormatError (ARCHIVE_ENTRY_NAME)."""
    name = name.removesuffix("/")
    while name.startswith("./"):
        name = name[2:]
    if name in (".", ""):
        return "."
    parts = name.split("/")
    if len(name.encode()) > MAX_NAME_BYTES or len(parts) > MAX_PARTS:
        raise archive_error("a member's name is too long", "ARCHIVE_ENTRY_NAME")
    if not all(_PART.fullmatch(part) and part not in (".", "..") for part in parts):
        raise archive_error("a member's name leaves the archive's folder or is not a valid name", "ARCHIVE_ENTRY_NAME")
    return name


def _stored_name(header: bytes) -> str:
    name = _text(header[:100].split(b"\0")[0])
    prefix = _text(header[345:500].split(b"\0")[0]) if header[257:263] == b"ustar\0" else ""
    return f"{prefix}/{name}" if prefix else name


def _text(raw: bytes) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise archive_error("a member's name is not UTF-8", "ARCHIVE_ENTRY_NAME") from error


def _number(field: bytes) -> int:
    """Octal digits, or a big-endian number behind the byte 0x80."""
    if field[0] == 0x80:
        value = int.from_bytes(field[1:], "big")
    else:
        digits = field.strip(b" \0")
        if digits and (len(digits) > 11 or digits.strip(b"01234567")):
            raise archive_error("a header's number is malformed")
        value = int(digits or b"0", 8)
    if value > _MAX_NUMBER:
        raise archive_error("a member claims more bytes than any file has", "ARCHIVE_TOO_LARGE")
    return value


def _check_sum(header: bytes) -> None:
    if sum(header[:148]) + 8 * 32 + sum(header[156:]) != _number(header[148:156]):
        raise archive_error("a header's sum is wrong")


def _require_end(stream: ByteStream) -> None:
    """Behind the first empty block comes at least one more, and nothing else."""
    tail = 0
    for piece in stream.rest():
        tail += len(piece)
        if tail > _MAX_TAIL or any(piece):
            raise archive_error("something lies behind the archive's end", "ARCHIVE_TRAILING_DATA")


def _bytes(stream: ByteStream, size: int) -> bytes:
    return b"".join(stream.pieces(size))


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

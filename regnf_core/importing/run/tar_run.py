"""A run in a tar file, plain or packed. It is read from first to last, once for the names and once for the contents."""

from __future__ import annotations

import bz2
import itertools
import lzma
import mmap
import re
import tarfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.zip_members import require_modest

# Where an archive's members go as they are unpacked: small ones into memory, large ones into a file that is mapped.

MAX_NAME_BYTES, MAX_PARTS = 512, 32
_IN_MEMORY = 1 << 20


def archive_error(message: str, reason: str = "ARCHIVE_MALFORMED") -> FieldFormatError:
    """The error for an archive of a run that is not taken."""
    return FieldFormatError(message, reason=reason)


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


# What a packed file unpacks to, a piece at a time.

_PIECE = 1 << 20
_XZ_MEMORY = 256 << 20
_UNPACKERS: dict[str, Callable[[], Any]] = {
    "gzip": lambda: zlib.decompressobj(16 + zlib.MAX_WBITS),
    "bzip2": bz2.BZ2Decompressor,
    "xz": lambda: lzma.LZMADecompressor(memlimit=_XZ_MEMORY),
}


def _unpacked(data: memoryview, packing: str, most: int) -> Iterator[bytes]:
    """One packed stream. Nothing may follow it."""
    unpacker, at, total = _UNPACKERS[packing](), 0, 0
    try:
        while not unpacker.eof:
            waiting = getattr(unpacker, "unconsumed_tail", b"")  # zlib gives back what the others keep
            if not waiting and getattr(unpacker, "needs_input", True):
                waiting = data[at : at + _PIECE]
                at += len(waiting)
                if not waiting:
                    raise truncated()
            piece = unpacker.decompress(waiting, _PIECE)
            total += len(piece)
            require_modest(total, at, most)
            if piece:
                yield piece
    except (zlib.error, OSError, EOFError, ValueError, lzma.LZMAError) as error:
        raise archive_error(f"the {packing} file is damaged") from error
    if at != len(data) or unpacker.unused_data:
        raise archive_error(f"the {packing} file has data after its end", "ARCHIVE_TRAILING_DATA")


def truncated() -> FieldFormatError:
    """The error for an archive that ends too early."""
    return archive_error("the archive ends too early: the file is truncated", "FILE_TRUNCATED")


_MAX_MEMBERS = 16_384
_MAX_RECORDS = 64 * 1024
_MAX_TAIL = 1 << 20
_MOST_BYTES = 1 << 60
_PART = re.compile(r"[^\x00-\x1f\x7f/\\]+")
_OLD_TORCH = frozenset({"sys_info", "pickle", "storages", "tensors"})


class _Forward:
    """Bytes from first to last, as ``tarfile`` reads them; there is no way back."""

    def __init__(self, source: Iterator[bytes] | Iterator[memoryview], is_packed: bool) -> None:
        self._is_packed = is_packed
        self._source, self._waiting, self._at = source, memoryview(b""), 0
        self.last = b""
        """What was read last; a header of zeros is the archive's end."""

    def pieces(self, size: int) -> Iterator[memoryview]:
        """The next ``size`` bytes; of a map they are one piece. Raises FieldFormatError (FILE_TRUNCATED)."""
        self._at += size
        while size:
            if not self._waiting:
                piece = next(self._source, None)
                if piece is None and self._is_packed and self._at <= tarfile.BLOCKSIZE:
                    raise tarfile.ReadError  # a whole file, shorter than an archive's first header
                if piece is None:
                    raise truncated()
                self._waiting = memoryview(piece)
            part, self._waiting = self._waiting[:size], self._waiting[size:]
            size -= len(part)
            yield part

    def read(self, size: int) -> bytes:
        """A header, or what one says about the next member."""
        if size > _MAX_RECORDS:
            raise archive_error("a header has too much data", "ARCHIVE_ENTRY_NAME")
        self.last = b"".join(self.pieces(size))
        return self.last

    def tell(self) -> int:
        """Where the next byte lies."""
        return self._at

    def seek(self, position: int) -> None:
        """Go over what nobody requested."""
        if position < self._at:
            raise archive_error("a header's number is malformed")
        for _ in self.pieces(position - self._at):
            pass

    def require_end(self) -> None:
        """Behind the first empty block come more of them, and nothing else."""
        if any(self.last):
            raise archive_error("a header is malformed")
        tail = 0
        for piece in itertools.chain([self._waiting], self._source):
            tail += len(piece)
            if tail > _MAX_TAIL or any(piece):
                raise archive_error("the file has data after the archive's end", "ARCHIVE_TRAILING_DATA")


class TarRun:
    """The members of one tar file by name. packing: gzip, bzip2, xz or None. ``most`` caps the bytes unpacked.

    Raises FieldFormatError: FILE_TRUNCATED, LEGACY_TORCH_FILE and the ARCHIVE_* reasons of docs/import-gate.md.
    """

    def __init__(self, data: memoryview, packing: str | None, most: int, members: int = _MAX_MEMBERS) -> None:
        self._data, self._packing, self._most, self._most_members = data, packing, most, members
        self.sizes: dict[str, int] = {}
        """Each member's size in bytes."""
        for name, size, _ in self._members():
            if name in self.sizes:
                raise archive_error("two members share a name", "ARCHIVE_DUPLICATE_ENTRY")
            self.sizes[name] = size

    def take(self, names: Collection[str], folder: Path) -> dict[str, memoryview]:
        """The members of these names. Raises FieldFormatError (ARCHIVE_TOO_LARGE)."""
        require_modest(sum(self.sizes[name] for name in names), len(self._data), self._most)
        taken = {}
        for name, size, stream in self._members():
            if name in names:
                pieces = stream.pieces(size)
                first = next(pieces, memoryview(b""))  # a member of a map is a view of it
                taken[name] = first if len(first) == size else kept(itertools.chain([first], pieces), size, folder)
            if len(taken) == len(names):
                return taken
        raise archive_error("the archive has changed while it was read")

    def each(self) -> Iterator[tuple[str, bytes]]:
        """Name and content of each plain file, in their order."""
        for name, size, stream in self._members():
            yield name, b"".join(stream.pieces(size))

    def _members(self) -> Iterator[tuple[str, int, _Forward]]:
        """Name and size of each plain file in order, and the stream, which stands at its content."""
        packing = self._packing
        source = iter((self._data,)) if packing is None else _unpacked(self._data, packing, self._most)
        stream = _Forward(source, packing is not None)
        try:
            archive = tarfile.TarFile(fileobj=stream, encoding="utf-8", errors="strict")  # type: ignore[arg-type]
            for number, member in enumerate(archive):
                if number >= self._most_members:
                    raise archive_error(f"more than {self._most_members} members", "ARCHIVE_TOO_MANY_ENTRIES")
                name = _checked_name(member)
                if not member.isdir():
                    yield name, member.size, stream
        except UnicodeDecodeError as error:
            raise archive_error("a member's name is not UTF-8", "ARCHIVE_ENTRY_NAME") from error
        except (tarfile.TarError, ValueError, RecursionError) as error:
            if packing is None:
                raise archive_error("a header is malformed") from error
            message = f"a single file compressed with {packing}, or a damaged archive: decompress it, and give the file"
            raise archive_error(message) from error
        stream.require_end()


def _checked_name(member: tarfile.TarInfo) -> str:
    """The name below the archive's folder, of a plain file or a folder. Raises FieldFormatError."""
    if member.islnk() or member.issym():
        message = "the archive has a link; pack the file to which it points (tar --dereference)"
        raise archive_error(message, "ARCHIVE_LINK")
    if member.issparse():
        raise archive_error("the archive has a sparse file; pack it without --sparse", "ARCHIVE_SPECIAL_FILE")
    if member.type not in (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE):
        message = "the archive has a device, a sparse file or something other than plain files"
        raise archive_error(message, "ARCHIVE_SPECIAL_FILE")
    if not 0 <= member.size <= _MOST_BYTES:
        raise archive_error("a member has an impossible size", "ARCHIVE_TOO_LARGE")
    if member.isdir() and member.size:
        raise archive_error("a folder with a content")
    name = re.sub(r"^(\./)+", "", member.name.removesuffix("/"))
    if name in (".", ""):
        if member.isdir():
            return "."
        raise archive_error("a member without a name", "ARCHIVE_ENTRY_NAME")
    parts = name.split("/")
    if len(name.encode()) > MAX_NAME_BYTES or len(parts) > MAX_PARTS:
        raise archive_error("a member's name is too long", "ARCHIVE_ENTRY_NAME")
    if not all(_PART.fullmatch(part) and part not in (".", "..") for part in parts):
        raise archive_error(
            "a member's name is invalid, or its path leads out of the archive's folder", "ARCHIVE_ENTRY_NAME"
        )
    if name in _OLD_TORCH and not member.isdir():
        message = "a tar archive of PyTorch before version 0.1.10; save it again"
        raise archive_error(message, "LEGACY_TORCH_FILE")
    return name

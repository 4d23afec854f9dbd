"""The entries of a zip file, by a stricter reading than any library's: there is one way only to read what passes.

The entries, their descriptors, the central directory and the end records must tile the file exactly. So there is
nowhere to hide a second archive or an overlap, and every entry lies where it is said to lie.
"""

from __future__ import annotations

import re
import stat
import struct
from collections.abc import Collection
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers import zip_records as records
from regnf_core.importing.containers.zip_records import Directory, Header, malformed

MAX_ENTRIES = 16_384
STORED, DEFLATED = 0, 8
_ENCRYPTION_FLAGS = 0x0001 | 0x0040 | 0x2000
_DESCRIPTOR_FLAG = 0x0008
_UTF8_FLAG = 0x0800
_PART = re.compile(r"[^\x00-\x1f\x7f/\\]+")


@dataclass(frozen=True)
class Member:
    """``packed_size`` bytes at ``offset`` of the file, and the size and CRC-32 of what they unpack to."""

    name: str
    method: int
    offset: int
    packed_size: int
    size: int
    crc32: int


def read_members(data: memoryview, methods: Collection[int] = (STORED,), folders: bool = False) -> list[Member]:
    """Check the structure of the zip file ``data`` and list its entries in the order in which they lie.

    ``methods`` are the ways of compression that are allowed. folders: take empty entries for folders too, whose names
    end in a slash. Nothing is unpacked. Names have no part that is empty,
    ``.`` or ``..``, and no control character. Raises FieldFormatError: FILE_TRUNCATED and the ARCHIVE_* reasons of
    docs/import-gate.md.
    """
    _check_ends(data)
    directory = records.read_directory_end(data)
    return _tile(data, _central_headers(data, directory, methods), directory.offset, folders)


def _check_ends(data: memoryview) -> None:
    """The file begins with an entry and ends with the directory's end record."""
    if bytes(data[:4]) != records.LOCAL_SIGNATURE[: len(data[:4])]:
        raise malformed("something lies before the archive", "ARCHIVE_PREFIXED_DATA")
    at = len(data) - records.END_SIZE
    if at > 0 and data[at : at + 4] == records.END_SIGNATURE and bytes(data[-2:]) == b"\0\0":
        return
    tail = bytes(data[-(records.END_SIZE + 0xFFFF) :])
    found = tail.rfind(records.END_SIGNATURE)
    if 0 <= found <= len(tail) - records.END_SIZE:
        raise malformed("something lies behind the archive", "ARCHIVE_TRAILING_DATA")
    raise FieldFormatError("the archive's end is missing: the file was cut short", reason="FILE_TRUNCATED")


def _central_headers(data: memoryview, directory: Directory, methods: Collection[int]) -> list[Header]:
    if not 0 < directory.count <= MAX_ENTRIES:
        raise malformed(f"{directory.count} entries; at most {MAX_ENTRIES} are read", "ARCHIVE_TOO_MANY_ENTRIES")
    headers = []
    at = directory.offset
    for _ in range(directory.count):
        header = records.read_central_header(data, at, directory.end)
        _check_header(header, directory.offset, methods)
        headers.append(header)
        at = header.end
    if at != directory.end:
        raise malformed("the central directory holds more than its entries")
    if len({header.name for header in headers}) != len(headers):
        raise malformed("two entries share a name", "ARCHIVE_DUPLICATE_ENTRY")
    return headers


def _check_header(header: Header, data_end: int, methods: Collection[int]) -> None:
    if header.flags & _ENCRYPTION_FLAGS:
        raise malformed("an entry is encrypted", "ARCHIVE_ENCRYPTED")
    if stat.S_ISLNK(header.mode):
        raise malformed("the archive holds a link; pack what it leads to (zip without -y)", "ARCHIVE_LINK")
    if stat.S_IFMT(header.mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise malformed("the archive holds something else than plain files", "ARCHIVE_SPECIAL_FILE")
    if header.method not in methods:
        raise malformed("an entry is compressed in a way that is not taken", "ARCHIVE_COMPRESSED_ENTRY")
    if header.flags & ~(_DESCRIPTOR_FLAG | _UTF8_FLAG | _deflate_flags(header)):
        raise malformed("an entry has flags that no trainer's library sets")
    if header.method == STORED and header.compressed_size != header.size:
        raise malformed("a stored entry has two sizes", "ARCHIVE_HEADER_MISMATCH")
    if header.compressed_size > data_end or header.local_offset >= data_end:
        raise malformed("an entry claims bytes beyond the file's", "ARCHIVE_ENTRY_OUT_OF_BOUNDS")


def _deflate_flags(header: Header) -> int:
    """The two flags in which a deflated entry may tell how hard the packer tried."""
    return 0x0006 if header.method == DEFLATED else 0


def _tile(data: memoryview, headers: list[Header], data_end: int, folders: bool) -> list[Member]:
    """Entries in file order: each must begin where the one before ends, from 0 to ``data_end`` without a gap."""
    members = []
    expected = 0
    for central in sorted(headers, key=lambda header: header.local_offset):
        if central.local_offset != expected:
            raise _gap(expected, central.local_offset)
        local = records.read_local_header(data, central.local_offset, data_end)
        _check_same(central, local)
        end = local.end + central.compressed_size
        if end > data_end:
            raise malformed("an entry overlaps the central directory", "ARCHIVE_OVERLAP")
        expected = end + _descriptor_size(data, central, end, data_end)
        members.append(_member(central, local.end, folders))
    if expected != data_end:
        raise _gap(expected, data_end)
    return members


def _member(header: Header, offset: int, folders: bool) -> Member:
    name = _decoded(header)
    path = name.removesuffix("/") if folders and header.size == 0 else name
    if not all(_PART.fullmatch(part) and part not in (".", "..") for part in path.split("/")):
        raise malformed("an entry's name leaves the archive's folder or is not a valid name", "ARCHIVE_ENTRY_NAME")
    return Member(name, header.method, offset, header.compressed_size, header.size, header.crc32)


def _gap(expected: int, found: int) -> FieldFormatError:
    if found < expected:
        return malformed("two entries overlap", "ARCHIVE_OVERLAP")
    if expected == 0:
        return malformed("something lies before the archive", "ARCHIVE_PREFIXED_DATA")
    return malformed("bytes that belong to no entry", "ARCHIVE_HIDDEN_DATA")


def _check_same(central: Header, local: Header) -> None:
    same = (central.name, central.flags, central.method) == (local.name, local.flags, local.method)
    packed = (local.compressed_size, central.compressed_size)
    pairs = ((local.crc32, central.crc32), (local.size, central.size), packed)
    later = bool(central.flags & _DESCRIPTOR_FLAG)
    if not same or any(here != there and not (later and here == 0) for here, there in pairs):
        raise malformed("a local header contradicts the central directory", "ARCHIVE_HEADER_MISMATCH")


def _descriptor_size(data: memoryview, central: Header, at: int, limit: int) -> int:
    """Length of the data descriptor at ``at``: signature, CRC and sizes, 32- or 64-bit. 0 where the flag is unset."""
    if not central.flags & _DESCRIPTOR_FLAG:
        return 0
    for layout, largest in (("<4sIII", 0xFFFFFFFF), ("<4sIQQ", 1 << 63)):
        length = struct.calcsize(layout)
        if max(central.size, central.compressed_size) > largest or at + length > limit:
            continue
        wanted = struct.pack(layout, records.DESCRIPTOR_SIGNATURE, central.crc32, central.compressed_size, central.size)
        if bytes(data[at : at + length]) == wanted:
            return length
    raise malformed("the descriptor behind an entry contradicts the central directory", "ARCHIVE_HEADER_MISMATCH")


def _decoded(header: Header) -> str:
    try:
        return header.name.decode("utf-8")
    except UnicodeDecodeError as error:
        raise malformed("an entry's name is not UTF-8", "ARCHIVE_ENTRY_NAME") from error

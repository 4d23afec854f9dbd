"""The zip container of torch.save, checked against its own rules instead of a lenient reader's.

torch.save stores every entry uncompressed and leaves no byte unaccounted for, so the check is strict: the entries,
their descriptors, the central directory and the end records must tile the file exactly. What passes has one reading
only: there is nowhere to hide a second archive, an overlap or a bomb, and every entry can be mapped where it lies.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError
from regnf_core.importing import zip_records as records
from regnf_core.importing.zip_records import Directory, Header, malformed

MAX_ENTRIES = 16_384
MAX_PICKLE_BYTES = 32 * 1024 * 1024
_ENCRYPTION_FLAGS = 0x0001 | 0x0040 | 0x2000
_DESCRIPTOR_FLAG = 0x0008
_UTF8_FLAG = 0x0800
_PART = re.compile(r"[^\x00-\x1f\x7f/\\]+")
_CRC_CHUNK = 1 << 24


@dataclass(frozen=True)
class Entry:
    """One stored entry: ``size`` bytes at ``offset`` of the file, with the CRC-32 the directory claims."""

    name: str
    offset: int
    size: int
    crc32: int


@dataclass(frozen=True)
class TorchArchive:
    """The entries by their name below the archive's folder: "data.pkl", "data/0" ..."""

    data: memoryview
    entries: dict[str, Entry]

    def read(self, name: str) -> memoryview:
        """The entry's bytes, not copied, after checking their CRC. Raises FieldFormatError (ARCHIVE_CRC_MISMATCH)."""
        entry = self.entries[name]
        view = self.data[entry.offset : entry.offset + entry.size]
        crc32 = 0
        for start in range(0, entry.size, _CRC_CHUNK):
            crc32 = zlib.crc32(view[start : start + _CRC_CHUNK], crc32)
        if crc32 != entry.crc32:
            raise malformed(f"the bytes of {name} are damaged (CRC)", "ARCHIVE_CRC_MISMATCH")
        return view


def read_archive(data: memoryview, max_pickle_bytes: int = MAX_PICKLE_BYTES) -> TorchArchive:
    """Check the container's structure and list its entries. ``data`` is the whole file, usually a memory map.

    Raises FieldFormatError: FILE_TRUNCATED, PICKLE_TOO_LARGE and the ARCHIVE_* reasons of docs/import-gate.md.
    """
    _check_ends(data)
    directory = records.read_directory_end(data)
    headers = _central_headers(data, directory)
    entries = _tile(data, headers, directory.offset)
    members = _below_one_folder(entries)
    if any(name == "constants.pkl" or name.startswith("code/") for name in members):
        raise malformed("a TorchScript archive holds a program, not weights", "ARCHIVE_TORCHSCRIPT")
    if sum(name.rsplit("/", 1)[-1] == "data.pkl" for name in members) > 1:
        raise malformed("more than one data.pkl", "ARCHIVE_DUPLICATE_ENTRY")
    if "data.pkl" not in members:
        raise malformed("the archive has no data.pkl: torch.save did not write it", "ARCHIVE_NO_PICKLE")
    if members["data.pkl"].size > max_pickle_bytes:
        raise malformed(f"data.pkl is larger than {max_pickle_bytes} bytes", "PICKLE_TOO_LARGE")
    archive = TorchArchive(data, members)
    if "byteorder" in members and bytes(archive.read("byteorder")[:16]) != b"little":
        raise malformed("the tensors are not little-endian", "ARCHIVE_BYTE_ORDER")
    return archive


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


def _central_headers(data: memoryview, directory: Directory) -> list[Header]:
    if not 0 < directory.count <= MAX_ENTRIES:
        raise malformed(f"{directory.count} entries; at most {MAX_ENTRIES} are read", "ARCHIVE_TOO_MANY_ENTRIES")
    headers = []
    at = directory.offset
    for _ in range(directory.count):
        header = records.read_central_header(data, at, directory.end)
        _check_header(header, directory.offset)
        headers.append(header)
        at = header.end
    if at != directory.end:
        raise malformed("the central directory holds more than its entries")
    if len({header.name for header in headers}) != len(headers):
        raise malformed("two entries share a name", "ARCHIVE_DUPLICATE_ENTRY")
    return headers


def _check_header(header: Header, data_end: int) -> None:
    if header.flags & _ENCRYPTION_FLAGS:
        raise malformed("an entry is encrypted", "ARCHIVE_ENCRYPTED")
    if header.method != 0:
        raise malformed("an entry is compressed; torch.save stores entries as they are", "ARCHIVE_COMPRESSED_ENTRY")
    if header.flags & ~(_DESCRIPTOR_FLAG | _UTF8_FLAG):
        raise malformed("an entry has flags that torch.save never sets")
    if header.compressed_size != header.size:
        raise malformed("a stored entry has two sizes", "ARCHIVE_HEADER_MISMATCH")
    if header.size > data_end or header.local_offset >= data_end:
        raise malformed("an entry claims bytes beyond the file's", "ARCHIVE_ENTRY_OUT_OF_BOUNDS")


def _tile(data: memoryview, headers: list[Header], data_end: int) -> list[Entry]:
    """Entries in file order: each must begin where the one before ends, from 0 to ``data_end`` without a gap."""
    entries = []
    expected = 0
    for central in sorted(headers, key=lambda header: header.local_offset):
        if central.local_offset != expected:
            raise _gap(expected, central.local_offset)
        local = records.read_local_header(data, central.local_offset, data_end)
        _check_same(central, local)
        end = local.end + central.size
        if end > data_end:
            raise malformed("an entry overlaps the central directory", "ARCHIVE_OVERLAP")
        expected = end + _descriptor_size(data, central, end, data_end)
        entries.append(Entry(_decoded(central), local.end, central.size, central.crc32))
    if expected != data_end:
        raise _gap(expected, data_end)
    return entries


def _gap(expected: int, found: int) -> FieldFormatError:
    if found < expected:
        return malformed("two entries overlap", "ARCHIVE_OVERLAP")
    if expected == 0:
        return malformed("something lies before the archive", "ARCHIVE_PREFIXED_DATA")
    return malformed("bytes that belong to no entry", "ARCHIVE_HIDDEN_DATA")


def _check_same(central: Header, local: Header) -> None:
    same = (central.name, central.flags, central.method) == (local.name, local.flags, local.method)
    pairs = ((local.crc32, central.crc32), (local.size, central.size), (local.compressed_size, central.size))
    later = bool(central.flags & _DESCRIPTOR_FLAG)
    if not same or any(here != there and not (later and here == 0) for here, there in pairs):
        raise malformed("a local header contradicts the central directory", "ARCHIVE_HEADER_MISMATCH")


def _descriptor_size(data: memoryview, central: Header, at: int, limit: int) -> int:
    """Length of the data descriptor at ``at``: signature, CRC and sizes, 32- or 64-bit. 0 where the flag is unset."""
    if not central.flags & _DESCRIPTOR_FLAG:
        return 0
    for layout, largest in (("<4sIII", 0xFFFFFFFF), ("<4sIQQ", 1 << 63)):
        length = struct.calcsize(layout)
        if central.size > largest or at + length > limit:
            continue
        wanted = struct.pack(layout, records.DESCRIPTOR_SIGNATURE, central.crc32, central.size, central.size)
        if bytes(data[at : at + length]) == wanted:
            return length
    raise malformed("the descriptor behind an entry contradicts the central directory", "ARCHIVE_HEADER_MISMATCH")


def _decoded(header: Header) -> str:
    try:
        return header.name.decode("utf-8")
    except UnicodeDecodeError as error:
        raise malformed("an entry's name is not UTF-8", "ARCHIVE_ENTRY_NAME") from error


def _below_one_folder(entries: list[Entry]) -> dict[str, Entry]:
    """Entries by their name below the one folder all of them share. Names that could leave it are refused."""
    members = {}
    folders = set()
    for entry in entries:
        parts = entry.name.split("/")
        safe = all(_PART.fullmatch(part) and part not in (".", "..") for part in parts)
        if not safe or len(parts) < 2:
            raise malformed("an entry's name leaves the archive's folder or is no name", "ARCHIVE_ENTRY_NAME")
        folders.add(parts[0])
        members["/".join(parts[1:])] = entry
    if len(folders) != 1:
        raise malformed("entries lie in several folders", "ARCHIVE_ENTRY_NAME")
    return members

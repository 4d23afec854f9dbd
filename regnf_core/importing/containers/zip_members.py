"""The entries of a zip file, by a stricter reading than any library's: there is one way only to read what passes.

The entries, their descriptors, the central directory and the end records must tile the file exactly. So there is
nowhere to hide a second archive or an overlap, and every entry lies where it is said to lie.
"""

from __future__ import annotations

import re
import stat
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError

# The records of a zip file, decoded and bounds-checked one at a time.

LOCAL_SIGNATURE = b"PK\x03\x04"
_CENTRAL_SIGNATURE = b"PK\x01\x02"
END_SIGNATURE = b"PK\x05\x06"
_END64_SIGNATURE = b"PK\x06\x06"
_LOCATOR64_SIGNATURE = b"PK\x06\x07"
DESCRIPTOR_SIGNATURE = b"PK\x07\x08"

_LOCAL = struct.Struct("<4sHHHHHIIIHH")
_CENTRAL = struct.Struct("<4sHHHHHHIIIHHHHHII")
_END = struct.Struct("<4sHHHHIIH")
_END64 = struct.Struct("<4sQHHIIQQQQ")
_LOCATOR64 = struct.Struct("<4sIQI")
END_SIZE = _END.size
_ZIP64_EXTRA = 1
_MAX16, _MAX32 = 0xFFFF, 0xFFFFFFFF
_MAX_NAME_BYTES = 512
_MAX_EXTRA_FIELDS = 8


def malformed(message: str, reason: str = "ARCHIVE_MALFORMED") -> FieldFormatError:
    """The error for a container fault."""
    return FieldFormatError(message, reason=reason)


_Directory = tuple[int, int, int]
"""Where the central directory begins and ends (bytes from the file's start), and how many entries it claims."""


@dataclass(frozen=True)
class Header:
    """One entry's header, central or local. ``end`` is where the header's own bytes end · mode: of the file on a Unix
    system, its kind included, 0 where that is not said; a central header says it."""

    name: bytes
    flags: int
    method: int
    crc32: int
    compressed_size: int
    size: int
    local_offset: int
    end: int
    mode: int = 0


def _directory_end(data: memoryview) -> _Directory:
    """The end-of-central-directory record, which must be the file's last 22 bytes, and its zip64 companion if any.

    Raises FieldFormatError: ARCHIVE_MALFORMED, or ARCHIVE_MULTI_DISK for a part of a split archive.
    """
    at = len(data) - END_SIZE
    _, disk, start_disk, here, count, size, offset, _ = _END.unpack_from(data, at)
    if disk or start_disk or here != count:
        raise malformed("the archive is one part of a split archive", "ARCHIVE_MULTI_DISK")
    locator_at = at - _LOCATOR64.size
    if locator_at >= 0 and data[locator_at : locator_at + 4] == _LOCATOR64_SIGNATURE:
        wide = start, end, entries = _directory_end64(data, locator_at)
        narrow = ((count, entries, _MAX16), (size, end - start, _MAX32), (offset, start, _MAX32))
        if any(short not in (long, sentinel) for short, long, sentinel in narrow):
            raise malformed("the two directory records disagree")
        return wide
    if count == _MAX16 or _MAX32 in (size, offset):
        raise malformed("the zip64 directory record is missing")
    if offset + size != at:
        raise malformed("the end of the central directory contradicts its record")
    return offset, at, count


def _directory_end64(data: memoryview, locator_at: int) -> _Directory:
    _, disk, end64_at, disks = _LOCATOR64.unpack_from(data, locator_at)
    if disk or disks != 1:
        raise malformed("the archive is one part of a split archive", "ARCHIVE_MULTI_DISK")
    if end64_at + _END64.size != locator_at or data[end64_at : end64_at + 4] != _END64_SIGNATURE:
        raise malformed("the zip64 directory record is not at the place that its locator gives")
    _, record, _, _, disk, start_disk, here, count, size, offset = _END64.unpack_from(data, end64_at)
    if disk or start_disk or here != count:
        raise malformed("the archive is one part of a split archive", "ARCHIVE_MULTI_DISK")
    if record != _END64.size - 12 or offset + size != end64_at:
        raise malformed("the end of the central directory contradicts the zip64 record")
    return offset, end64_at, count


def _central_header(data: memoryview, at: int, limit: int) -> Header:
    """The central header at ``at``; nothing of it may reach past ``limit``."""
    if at + _CENTRAL.size > limit or data[at : at + 4] != _CENTRAL_SIGNATURE:
        raise malformed("the central directory has something that is not an entry")
    values = _CENTRAL.unpack_from(data, at)
    flags, method, crc32, packed, size = values[3], values[4], values[7], values[8], values[9]
    name_length, extra_length, comment_length, disk, offset = *values[10:14], values[16]
    if name_length > _MAX_NAME_BYTES:
        raise malformed("an entry's name is too long", "ARCHIVE_ENTRY_NAME")
    name_at = at + _CENTRAL.size
    end = name_at + name_length + extra_length
    if comment_length or disk or end > limit:
        raise malformed("a central header was not written by torch.save")
    wide = _zip64_values(data[name_at + name_length : end])
    size, packed, offset = (_widened(value, wide) for value in (size, packed, offset))
    name, mode = bytes(data[name_at : name_at + name_length]), values[15] >> 16
    return Header(name, flags, method, crc32, packed, size, offset, end, mode)


def _local_header(data: memoryview, at: int, limit: int) -> Header:
    """The local header at ``at``; sizes and CRC are zero where a descriptor after the data carries them."""
    if at + _LOCAL.size > limit or data[at : at + 4] != LOCAL_SIGNATURE:
        raise malformed("no local header at the place that the central directory gives", "ARCHIVE_HEADER_MISMATCH")
    _, _, flags, method, _, _, crc32, packed, size, name_length, extra_length = _LOCAL.unpack_from(data, at)
    name_at = at + _LOCAL.size
    end = name_at + name_length + extra_length
    if end > limit:
        raise malformed("a local header extends beyond the directory", "ARCHIVE_HEADER_MISMATCH")
    wide = _zip64_values(data[name_at + name_length : end])
    size, packed = (_widened(value, wide) for value in (size, packed))
    return Header(bytes(data[name_at : name_at + name_length]), flags, method, crc32, packed, size, at, end)


def _zip64_values(extra: memoryview) -> list[int]:
    """The 64-bit numbers of the zip64 extra field, in order; the other extra fields (padding) are only walked."""
    found: list[int] | None = None
    at = fields = 0
    while at < len(extra):
        fields += 1
        if at + 4 > len(extra) or fields > _MAX_EXTRA_FIELDS:
            raise malformed("an extra field is truncated, or there are too many")
        kind, length = struct.unpack_from("<HH", extra, at)
        at += 4
        if at + length > len(extra):
            raise malformed("an extra field is truncated")
        if kind == _ZIP64_EXTRA:
            if found is not None or length > 28:
                raise malformed("the zip64 field occurs twice or is too long")
            found = [value for (value,) in struct.iter_unpack("<Q", extra[at : at + length // 8 * 8])]
        at += length
    return found or []


def _widened(value: int, wide: list[int]) -> int:
    """The value itself, or the next 64-bit one where the 32-bit field holds the sentinel."""
    if value != _MAX32:
        return value
    if not wide:
        raise malformed("a zip64 size is missing")
    return wide.pop(0)


MAX_ENTRIES = 16_384
FREE_BYTES = 64 << 20
"""What an archive may unpack to without anybody looking at how tightly it was packed."""
MAX_RATIO = 200
"""Beyond that, bytes unpacked for a byte packed. Checkpoints of trained fields stay below 10."""
_PIECE = 1 << 20
STORED, DEFLATED = 0, 8
_ENCRYPTION_FLAGS = 0x0001 | 0x0040 | 0x2000
_DESCRIPTOR_FLAG = 0x0008
_UTF8_FLAG = 0x0800
_PART = re.compile(r"[^\x00-\x1f\x7f/\\]+")


def require_modest(unpacked: int, packed: int, most: int) -> None:
    """Raise FieldFormatError (ARCHIVE_TOO_LARGE) for what unpacks to more than ``most`` bytes, or to many from few."""
    if unpacked > most:
        raise malformed(f"the archive unpacks to more than {most} bytes", "ARCHIVE_TOO_LARGE")
    if unpacked > FREE_BYTES + MAX_RATIO * packed:
        raise malformed(f"the archive unpacks to more than {MAX_RATIO} times its size", "ARCHIVE_TOO_LARGE")


@dataclass(frozen=True)
class Member:
    """``packed_size`` bytes at ``offset`` of the file, and the size and CRC-32 of what they unpack to."""

    name: str
    method: int
    offset: int
    packed_size: int
    size: int
    crc32: int | None
    """None: there is no checksum."""

    def content(self, data: memoryview, join: Callable[[Iterator[bytes], int], memoryview] | None = None) -> memoryview:
        """The member's bytes in the zip file ``data``: a view of what is stored, else what they inflate to.

        join: makes one of the inflated pieces, of so many bytes in all; None: in memory. Raises FieldFormatError:
        ARCHIVE_DEFLATE_MALFORMED or ARCHIVE_CRC_MISMATCH.
        """
        content = data[self.offset : self.offset + self.packed_size]
        if self.method == DEFLATED:
            pieces = self._inflated(content)
            content = memoryview(b"".join(pieces)) if join is None else join(pieces, self.size)
        crc32 = 0
        for start in range(0, len(content), _PIECE):
            crc32 = zlib.crc32(content[start : start + _PIECE], crc32)
        if self.crc32 not in (None, crc32):
            raise malformed(f"the bytes of {self.name} are damaged (CRC)", "ARCHIVE_CRC_MISMATCH")
        return content

    def _inflated(self, packed: memoryview) -> Iterator[bytes]:
        """Piece by piece; never more than the archive claims."""
        inflater, left, at = zlib.decompressobj(-zlib.MAX_WBITS), self.size, 0
        faulty = malformed(
            f"{self.name} has another uncompressed size than the archive states", "ARCHIVE_DEFLATE_MALFORMED"
        )
        waiting: bytes | memoryview = b""
        while not inflater.eof:
            if not waiting:
                waiting = packed[at : at + _PIECE]
                at += len(waiting)
            try:
                piece = inflater.decompress(waiting, min(_PIECE, left + 1))
            except zlib.error as error:
                raise faulty from error
            if len(piece) > left or (not piece and not waiting):
                raise faulty
            waiting = inflater.unconsumed_tail
            left -= len(piece)
            yield piece
        if left or waiting or inflater.unused_data or at != len(packed):
            raise faulty


def read_members(
    data: memoryview, methods: Collection[int] = (STORED,), folders: bool = False, most: int = MAX_ENTRIES
) -> list[Member]:
    """Check the structure of the zip file ``data`` and list its entries in the order in which they lie.

    ``methods`` are the ways of compression that are allowed. folders: take empty entries for folders too, whose names
    end in a slash. Nothing is unpacked. Names have no part that is empty,
    ``.`` or ``..``, and no control character. Raises FieldFormatError: FILE_TRUNCATED and the ARCHIVE_* reasons of
    docs/import-gate.md.
    """
    _check_ends(data)
    directory = _directory_end(data)
    return _tile(data, _central_headers(data, directory, methods, most), directory[0], folders)


def _check_ends(data: memoryview) -> None:
    """The file begins with an entry and ends with the directory's end record."""
    if bytes(data[:4]) != LOCAL_SIGNATURE[: len(data[:4])]:
        raise malformed("the file has data before the archive", "ARCHIVE_PREFIXED_DATA")
    at = len(data) - END_SIZE
    if at > 0 and data[at : at + 4] == END_SIGNATURE and bytes(data[-2:]) == b"\0\0":
        return
    tail = bytes(data[-(END_SIZE + 0xFFFF) :])
    found = tail.rfind(END_SIGNATURE)
    if 0 <= found <= len(tail) - END_SIZE:
        raise malformed("the file has data after the archive", "ARCHIVE_TRAILING_DATA")
    raise FieldFormatError("the archive's end is missing: the file is truncated", reason="FILE_TRUNCATED")


def _central_headers(data: memoryview, directory: _Directory, methods: Collection[int], most: int) -> list[Header]:
    at, end, count = directory
    if not 0 < count <= most:
        raise malformed(f"{count} entries; at most {most} are allowed", "ARCHIVE_TOO_MANY_ENTRIES")
    headers = []
    for _ in range(count):
        header = _central_header(data, at, end)
        _check_header(header, directory[0], methods)
        headers.append(header)
        at = header.end
    if at != end:
        raise malformed("the central directory has more data than its entries")
    if len({header.name for header in headers}) != len(headers):
        raise malformed("two entries share a name", "ARCHIVE_DUPLICATE_ENTRY")
    return headers


def _check_header(header: Header, data_end: int, methods: Collection[int]) -> None:
    if header.flags & _ENCRYPTION_FLAGS:
        raise malformed("an entry is encrypted", "ARCHIVE_ENCRYPTED")
    if stat.S_ISLNK(header.mode):
        raise malformed("the archive has a link; pack the file to which it points (zip without -y)", "ARCHIVE_LINK")
    if stat.S_IFMT(header.mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise malformed("the archive has something other than plain files", "ARCHIVE_SPECIAL_FILE")
    if header.method not in methods:
        raise malformed("the compression of an entry is not supported", "ARCHIVE_COMPRESSED_ENTRY")
    # A deflated entry may tell how hard the packer tried, in two flags.
    if header.flags & ~(_DESCRIPTOR_FLAG | _UTF8_FLAG | (0x0006 if header.method == DEFLATED else 0)):
        raise malformed("an entry has unexpected flags")
    if header.method == STORED and header.compressed_size != header.size:
        raise malformed("the two sizes of an uncompressed entry differ", "ARCHIVE_HEADER_MISMATCH")
    if header.compressed_size > data_end or header.local_offset >= data_end:
        raise malformed("an entry extends beyond the end of the file", "ARCHIVE_ENTRY_OUT_OF_BOUNDS")


def _tile(data: memoryview, headers: list[Header], data_end: int, folders: bool) -> list[Member]:
    """Entries in file order: each must begin where the one before ends, from 0 to ``data_end`` without a gap."""
    members = []
    expected = 0
    for central in sorted(headers, key=lambda header: header.local_offset):
        if central.local_offset != expected:
            raise _gap(expected, central.local_offset)
        local = _local_header(data, central.local_offset, data_end)
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
    try:
        name = header.name.decode("utf-8")
    except UnicodeDecodeError as error:
        raise malformed("an entry's name is not UTF-8", "ARCHIVE_ENTRY_NAME") from error
    path = name.removesuffix("/") if folders and header.size == 0 else name
    if not all(_PART.fullmatch(part) and part not in (".", "..") for part in path.split("/")):
        raise malformed(
            "an entry's name is invalid, or its path leads out of the archive's folder", "ARCHIVE_ENTRY_NAME"
        )
    return Member(name, header.method, offset, header.compressed_size, header.size, header.crc32)


def _gap(expected: int, found: int) -> FieldFormatError:
    if found < expected:
        return malformed("two entries overlap", "ARCHIVE_OVERLAP")
    if expected == 0:
        return malformed("the file has data before the archive", "ARCHIVE_PREFIXED_DATA")
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
        wanted = struct.pack(layout, DESCRIPTOR_SIGNATURE, central.crc32, central.compressed_size, central.size)
        if bytes(data[at : at + length]) == wanted:
            return length
    raise malformed("the descriptor after an entry contradicts the central directory", "ARCHIVE_HEADER_MISMATCH")

"""The records of a zip file, decoded and bounds-checked one at a time. ``container`` checks what they say."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError

Bytes = memoryview

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


@dataclass(frozen=True)
class Directory:
    """Where the central directory lies (bytes from the file's start) and how many entries it claims."""

    offset: int
    end: int
    count: int


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


def read_directory_end(data: Bytes) -> Directory:
    """The end-of-central-directory record, which must be the file's last 22 bytes, and its zip64 companion if any.

    Raises FieldFormatError: ARCHIVE_MALFORMED, or ARCHIVE_MULTI_DISK for a part of a split archive.
    """
    at = len(data) - END_SIZE
    _, disk, start_disk, here, count, size, offset, _ = _END.unpack_from(data, at)
    if disk or start_disk or here != count:
        raise malformed("the archive is one part of several", "ARCHIVE_MULTI_DISK")
    locator_at = at - _LOCATOR64.size
    if locator_at >= 0 and data[locator_at : locator_at + 4] == _LOCATOR64_SIGNATURE:
        wide = _read_directory_end64(data, locator_at)
        narrow = ((count, wide.count, _MAX16), (size, wide.end - wide.offset, _MAX32), (offset, wide.offset, _MAX32))
        if any(short not in (long, sentinel) for short, long, sentinel in narrow):
            raise malformed("the two directory records disagree")
        return wide
    if count == _MAX16 or _MAX32 in (size, offset):
        raise malformed("the zip64 directory record is missing")
    if offset + size != at:
        raise malformed("the central directory does not end where the record says")
    return Directory(offset, at, count)


def _read_directory_end64(data: Bytes, locator_at: int) -> Directory:
    _, disk, end64_at, disks = _LOCATOR64.unpack_from(data, locator_at)
    if disk or disks != 1:
        raise malformed("the archive is one part of several", "ARCHIVE_MULTI_DISK")
    if end64_at + _END64.size != locator_at or data[end64_at : end64_at + 4] != _END64_SIGNATURE:
        raise malformed("the zip64 directory record is not where its locator says")
    _, record, _, _, disk, start_disk, here, count, size, offset = _END64.unpack_from(data, end64_at)
    if disk or start_disk or here != count:
        raise malformed("the archive is one part of several", "ARCHIVE_MULTI_DISK")
    if record != _END64.size - 12 or offset + size != end64_at:
        raise malformed("the central directory does not end where the zip64 record says")
    return Directory(offset, end64_at, count)


def read_central_header(data: Bytes, at: int, limit: int) -> Header:
    """The central header at ``at``; nothing of it may reach past ``limit``."""
    if at + _CENTRAL.size > limit or data[at : at + 4] != _CENTRAL_SIGNATURE:
        raise malformed("the central directory holds something that is not an entry")
    values = _CENTRAL.unpack_from(data, at)
    flags, method, crc32, packed, size = values[3], values[4], values[7], values[8], values[9]
    name_length, extra_length, comment_length, disk, offset = *values[10:14], values[16]
    if name_length > _MAX_NAME_BYTES:
        raise malformed("an entry's name is too long", "ARCHIVE_ENTRY_NAME")
    name_at = at + _CENTRAL.size
    end = name_at + name_length + extra_length
    if comment_length or disk or end > limit:
        raise malformed("a central header is not one that torch.save writes")
    wide = _zip64_values(data[name_at + name_length : end])
    size, packed, offset = (_widened(value, wide) for value in (size, packed, offset))
    name, mode = bytes(data[name_at : name_at + name_length]), values[15] >> 16
    return Header(name, flags, method, crc32, packed, size, offset, end, mode)


def read_local_header(data: Bytes, at: int, limit: int) -> Header:
    """The local header at ``at``; sizes and CRC are zero where a descriptor after the data carries them."""
    if at + _LOCAL.size > limit or data[at : at + 4] != LOCAL_SIGNATURE:
        raise malformed("no local header where the central directory says", "ARCHIVE_HEADER_MISMATCH")
    _, _, flags, method, _, _, crc32, packed, size, name_length, extra_length = _LOCAL.unpack_from(data, at)
    name_at = at + _LOCAL.size
    end = name_at + name_length + extra_length
    if end > limit:
        raise malformed("a local header reaches past the directory", "ARCHIVE_HEADER_MISMATCH")
    wide = _zip64_values(data[name_at + name_length : end])
    size, packed = (_widened(value, wide) for value in (size, packed))
    return Header(bytes(data[name_at : name_at + name_length]), flags, method, crc32, packed, size, at, end)


def _zip64_values(extra: Bytes) -> list[int]:
    """The 64-bit numbers of the zip64 extra field, in order; the other extra fields (padding) are only walked."""
    found: list[int] | None = None
    at = fields = 0
    while at < len(extra):
        fields += 1
        if at + 4 > len(extra) or fields > _MAX_EXTRA_FIELDS:
            raise malformed("an extra field is cut short, or there are too many")
        kind, length = struct.unpack_from("<HH", extra, at)
        at += 4
        if at + length > len(extra):
            raise malformed("an extra field is cut short")
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

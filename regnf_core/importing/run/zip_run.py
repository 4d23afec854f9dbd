"""A run in a zip file, read as strictly as a checkpoint's own zip; but folders and deflated members are allowed."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

from regnf_core.importing.containers.zip_members import DEFLATED, STORED, Member, read_members
from regnf_core.importing.run.unpacking import MAX_PARTS, archive_error, kept, require_modest

_PIECE = 1 << 20


class ZipRun:
    """The members of one zip file by name. ``most`` caps the bytes of those that are unpacked."""

    def __init__(self, data: memoryview, most: int) -> None:
        members = read_members(data, (STORED, DEFLATED), folders=True)
        self._data = data
        self._most = most
        self._members = {member.name: member for member in members if not member.name.endswith("/")}
        if any(name.count("/") >= MAX_PARTS for name in self._members):
            raise archive_error("a member lies in too many folders", "ARCHIVE_ENTRY_NAME")

    @property
    def sizes(self) -> dict[str, int]:
        """Each member's size in bytes, as the archive claims it."""
        return {name: member.size for name, member in self._members.items()}

    def take(self, names: Collection[str], folder: Path) -> dict[str, memoryview]:
        """The members of these names. Raises FieldFormatError: ARCHIVE_TOO_LARGE, ARCHIVE_DEFLATE_MALFORMED,
        ARCHIVE_CRC_MISMATCH.
        """
        wanted = [self._members[name] for name in names]
        require_modest(sum(m.size for m in wanted), sum(m.packed_size for m in wanted), self._most)
        return {member.name: self._content(member, folder) for member in wanted}

    def _content(self, member: Member, folder: Path) -> memoryview:
        packed = self._data[member.offset : member.offset + member.packed_size]
        content = packed if member.method == STORED else kept(_inflated(packed, member), member.size, folder)
        crc32 = 0
        for start in range(0, len(content), _PIECE):
            crc32 = zlib.crc32(content[start : start + _PIECE], crc32)
        if crc32 != member.crc32:
            raise archive_error(f"the bytes of {member.name} are damaged (CRC)", "ARCHIVE_CRC_MISMATCH")
        return content


def _inflated(packed: memoryview, member: Member) -> Iterator[bytes]:
    """Piece by piece; never more than the archive claims."""
    inflater, left, at = zlib.decompressobj(-zlib.MAX_WBITS), member.size, 0
    faulty = archive_error(f"{member.name} does not inflate to what the archive claims", "ARCHIVE_DEFLATE_MALFORMED")
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

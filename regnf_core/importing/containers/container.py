"""The zip container of torch.save, checked against its own rules instead of a lenient reader's.

torch.save stores every entry uncompressed and leaves no byte unaccounted for, so there is nothing to inflate, and every
entry can be mapped where it lies.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError
from regnf_core.importing.containers.zip_members import DEFLATED, STORED, Member, read_members
from regnf_core.importing.containers.zip_records import malformed

MAX_PICKLE_BYTES = 32 * 1024 * 1024
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
    try:
        listed = read_members(data)
    except FieldFormatError as error:
        if error.reason == "ARCHIVE_COMPRESSED_ENTRY" and _is_program(_names_anyway(data)):
            raise _program() from error
        raise
    if _is_program(member.name for member in listed):
        raise _program()
    members = _below_one_folder(listed)
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


def _names_anyway(data: memoryview) -> list[str]:
    """The entries' names, compressed ones among them; none where the container is faulty as well."""
    try:
        return [member.name for member in read_members(data, (STORED, DEFLATED))]
    except FieldFormatError:
        return []


def _is_program(names: Iterable[str]) -> bool:
    inner = [name.partition("/")[2] for name in names]
    return any(name == "constants.pkl" or name.startswith("code/") for name in inner)


def _program() -> FieldFormatError:
    message = "a TorchScript archive holds a program, not weights: save state_dict() of it, or export it as ONNX"
    return malformed(message, "ARCHIVE_TORCHSCRIPT")


def _below_one_folder(members: list[Member]) -> dict[str, Entry]:
    """Entries by their name below the one folder all of them share."""
    entries = {}
    folders = set()
    for member in members:
        folder, _, name = member.name.partition("/")
        if not name:
            raise malformed("an entry lies in no folder", "ARCHIVE_ENTRY_NAME")
        folders.add(folder)
        entries[name] = Entry(member.name, member.offset, member.size, member.crc32)
    if len(folders) != 1:
        raise malformed("entries lie in several folders", "ARCHIVE_ENTRY_NAME")
    return entries

"""A library as one zip file: an index, and the safe fields that it names. Read as strictly as an upload.

library.json                     as in a library's folder
fields/{sha256}.safetensors      each entry's field, not compressed
"""

from __future__ import annotations

import hashlib
import mmap
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from regnf_core.errors import FieldFormatError, InvalidInputError
from regnf_core.field_source import naming
from regnf_core.files import atomic_path
from regnf_core.importing.containers.zip_members import Member, read_members
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.library_folder import INDEX, FolderEntry, index_of, index_text

_INDEX_BYTES = 16 << 20
_BLOCK = 1 << 20
_WRITTEN = (1980, 1, 1, 0, 0, 0)
"""The time of every member: the same library gives the same bytes."""


def write_archive(path: Path, entries: list[tuple[FolderEntry, Path]]) -> None:
    """Entries and their safe fields. The file is there once it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(INDEX, _WRITTEN), index_text([entry for entry, _ in entries]))
        for entry, field in entries:
            info = zipfile.ZipInfo(_name(entry), _WRITTEN)
            info.file_size = field.stat().st_size  # beyond 2 GiB the member needs larger numbers
            with field.open("rb") as source, archive.open(info, "w") as target:
                while block := source.read(_BLOCK):
                    target.write(block)


@dataclass(frozen=True)
class Archive:
    """An archive whose structure was checked; its fields still have to pass the import gate."""

    entries: list[FolderEntry]
    _data: memoryview
    _members: dict[str, Member]

    def extract(self, entry: FolderEntry, target: Path) -> None:
        """Write an entry's field. Raises FieldFormatError (ARCHIVE_HASH_MISMATCH) if the index says another one."""
        member = self._members[_name(entry)]
        digest = hashlib.sha256()
        with target.open("wb") as file:
            for at in range(member.offset, member.offset + member.size, _BLOCK):
                block = self._data[at : min(at + _BLOCK, member.offset + member.size)]
                digest.update(block)
                file.write(block)
        if digest.hexdigest() != entry.field:
            raise _refused(f"the field of {entry.notes.name!r} is not the one that the index names", "HASH_MISMATCH")


@contextmanager  # what is mapped ends with its last reader
def open_archive(path: Path) -> Iterator[Archive]:
    """An archive, to be read within the context.

    Raises FieldFormatError: FILE_EMPTY, FILE_TRUNCATED and the ARCHIVE_* reasons of docs/import-gate.md;
    InvalidInputError (LIBRARY_INDEX_INVALID).
    """
    with path.open("rb") as file, naming(path):
        if path.stat().st_size == 0:
            raise FieldFormatError("the file is empty", reason="FILE_EMPTY")
        yield _checked(memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)), path)


def _checked(data: memoryview, path: Path) -> Archive:
    members = {member.name: member for member in read_members(data)}
    index = members.get(INDEX)
    if index is None or index.size > _INDEX_BYTES:
        raise InvalidInputError(
            f"{path}: no library: it has no {INDEX}",
            reason="LIBRARY_INDEX_INVALID",
            hint="Give a file that `regnf library export` wrote.",
        )
    entries = index_of(bytes(data[index.offset : index.offset + index.size]), f"{path}: {INDEX}")
    expected = {INDEX, *map(_name, entries)}
    if members.keys() != expected:
        odd = sorted(members.keys() ^ expected)[0]
        raise _refused(f"index and fields differ: {odd}", "MALFORMED")
    most = ImportLimits().file_bytes
    if any(member.size > most for member in members.values()):
        raise _refused(f"a field has more than {most} bytes", "TOO_LARGE")
    return Archive(entries, data, members)


def _name(entry: FolderEntry) -> str:
    return f"fields/{entry.field}.safetensors"


def _refused(detail: str, why: str) -> FieldFormatError:
    return FieldFormatError(detail, reason=f"ARCHIVE_{why}")

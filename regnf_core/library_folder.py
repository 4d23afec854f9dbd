"""A library in a folder: regnf field files, their pictures, and an index. Torch-free but for adding.

library.json              names, tags, units, notes, symmetries
{sha256}.safetensors      a regnf field file, by the digest of its bytes
{sha256}.png              its picture, where there is one
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import mmap
import os
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from regnf_core.errors import FieldFormatError, InvalidInputError, NoSurfaceError, atomic_path
from regnf_core.field_source import FieldSource, naming
from regnf_core.importing.containers.zip_members import Member, read_members
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.library_entries import EntryNotes, checked_symmetry

INDEX = "library.json"
FORMAT = 1
_DIGITS = 64


@dataclass(frozen=True)
class FolderEntry:
    """field: SHA-256 of the regnf field file · detected: the symmetry that was found; None: there is no surface."""

    notes: EntryNotes
    field: str
    detected: dict[str, Any] | None = None

    @property
    def symmetry(self) -> dict[str, Any] | None:
        """The one that holds: what people say goes before what was detected."""
        return self.notes.symmetry or self.detected

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        return self.notes.to_dict() | {"field": self.field, "detected_symmetry": self.detected}

    @classmethod
    def from_dict(cls, values: Any) -> FolderEntry:
        """Of an index. Raises InvalidInputError (LIBRARY_ENTRY_INVALID)."""
        notes = EntryNotes.from_dict(values)
        field = values.get("field")
        if not (isinstance(field, str) and len(field) == _DIGITS and set(field) <= set("0123456789abcdef")):
            raise InvalidInputError("a field must be identified by its SHA-256", reason="LIBRARY_ENTRY_INVALID")
        return cls(notes, field, checked_symmetry(values.get("detected_symmetry")))


def index_text(entries: list[FolderEntry]) -> str:
    """An index as a file holds it."""
    return json.dumps({"format": FORMAT, "entries": [one.to_dict() for one in entries]}, ensure_ascii=False, indent=1)


def index_of(text: bytes, named: str) -> list[FolderEntry]:
    """The entries of an index. Raises InvalidInputError (LIBRARY_INDEX_INVALID), which names the file."""
    try:
        document = json.loads(text)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ValueError(f"expected an index of format {FORMAT}")
        entries = [FolderEntry.from_dict(values) for values in document["entries"]]
    except (ValueError, KeyError, TypeError, RecursionError, InvalidInputError) as error:
        raise _invalid(f"{named}: not an index of a library: {error}") from error
    for what in ({one.notes.name for one in entries}, {one.field for one in entries}):
        if len(what) < len(entries):
            raise _invalid(f"{named}: two entries have the same name or the same field")
    return entries


class LibraryFolder:
    """One library. Any number of processes may use it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def usual(cls) -> LibraryFolder:
        """The user's own: REGNF_LIBRARY, else below XDG_DATA_HOME or ~/.local/share."""
        base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
        return cls(Path(os.environ.get("REGNF_LIBRARY") or Path(base) / "regnf" / "library"))

    @staticmethod
    def is_one(folder: Path) -> bool:
        return (folder / INDEX).is_file()

    def entries(self, tag: str | None = None, part: str | None = None) -> list[FolderEntry]:
        """By name: those with the tag, and with ``part`` in their names. Raises InvalidInputError."""
        try:
            held = index_of((self.folder / INDEX).read_bytes(), str(self.folder / INDEX))
        except FileNotFoundError:
            return []
        found = [one for one in held if tag is None or tag in one.notes.tags]
        found = [one for one in found if part is None or part.casefold() in one.notes.name.casefold()]
        return sorted(found, key=lambda one: one.notes.name.casefold())

    def get(self, name: str) -> FolderEntry:
        """Raises InvalidInputError (LIBRARY_ENTRY_NOT_FOUND)."""
        for one in self.entries():
            if one.notes.name == name:
                return one
        hint = "`regnf library list` lists all names."
        raise InvalidInputError(f"{self.folder}: no entry {name!r}", reason="LIBRARY_ENTRY_NOT_FOUND", hint=hint)

    def file(self, entry: FolderEntry) -> Path:
        """The regnf field file."""
        return self.folder / f"{entry.field}.safetensors"

    def picture(self, entry: FolderEntry) -> Path:
        return self.folder / f"{entry.field}.png"

    def add(self, source: FieldSource, notes: EntryNotes) -> FolderEntry:
        """Import the field through the importer, find its symmetry, and keep it.

        Raises FieldFormatError naming the file, InvalidInputError (LIBRARY_NAME_TAKEN, FIELD_IN_LIBRARY).
        """
        from regnf_core.importing.gate.gate import FIELD_NAME, ImportLimits, import_field
        from regnf_core.importing.gate.picture import PICTURE_NAME

        self._require_free(self.entries(), FolderEntry(notes, ""))
        self.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".adding-", dir=self.folder) as made:
            with source.naming(), source.packed_settings() as settings:
                said = source.description or None
                import_field(source.file, Path(made), said, ImportLimits(), picture=True, settings=settings)
            field = Path(made) / FIELD_NAME
            entry = FolderEntry(notes, digest_of(field), _symmetry_of(field))
            with self._changing() as held:
                self._require_free(held, entry)
                os.replace(field, self.file(entry))
                if (Path(made) / PICTURE_NAME).exists():
                    os.replace(Path(made) / PICTURE_NAME, self.picture(entry))
                held.append(entry)
        return entry

    def change(self, name: str, notes: EntryNotes) -> FolderEntry:
        """Raises InvalidInputError (LIBRARY_ENTRY_NOT_FOUND, LIBRARY_NAME_TAKEN)."""
        with self._changing() as held:
            known = self.get(name)
            changed = FolderEntry(notes, known.field, known.detected)
            held.remove(known)
            self._require_free(held, changed)
            held.append(changed)
        return changed

    def remove(self, name: str) -> None:
        """The entry and its field. Raises InvalidInputError (LIBRARY_ENTRY_NOT_FOUND)."""
        with self._changing() as held:
            entry = self.get(name)
            held.remove(entry)
        for path in (self.file(entry), self.picture(entry)):
            path.unlink(missing_ok=True)

    @contextmanager
    def _changing(self) -> Iterator[list[FolderEntry]]:
        """The entries, to be changed; written at the end. One process at a time."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            held = self.entries()
            yield held
            with atomic_path(self.folder / INDEX, durable=True) as path:
                path.write_text(index_text(held), encoding="utf-8")

    def _require_free(self, held: list[FolderEntry], entry: FolderEntry) -> None:
        for one in held:
            if one.notes.name == entry.notes.name:
                message = f"{self.folder}: the entry {one.notes.name!r} exists already"
                hint = "Choose another name, or remove that entry first."
                raise InvalidInputError(message, reason="LIBRARY_NAME_TAKEN", hint=hint)
            if one.field == entry.field:
                message = f"the field is already the entry {one.notes.name!r}"
                hint = "Change that entry: `regnf library edit`."
                raise InvalidInputError(message, reason="FIELD_IN_LIBRARY", hint=hint)


def digest_of(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _symmetry_of(field: Path) -> dict[str, Any] | None:
    """Of the object in a regnf field file; its model is kept for searches. None for what has no surface."""
    from regnf_core.object_models import object_model
    from regnf_core.options import RobustOptions

    try:
        group = object_model(FieldSource(field, field), RobustOptions()).symmetry.group()
    except (NoSurfaceError, InvalidInputError):
        return None
    found = asdict(group)
    return found | {"axis": None if group.axis is None else list(group.axis)}


def _invalid(detail: str) -> InvalidInputError:
    hint = "Restore the file from a copy, or import an archive of the library into another folder."
    return InvalidInputError(detail, reason="LIBRARY_INDEX_INVALID", hint=hint)


# A library as one zip file: library.json and fields/{sha256}.safetensors, not compressed. Read as strictly as uploads.

_INDEX_BYTES = 16 << 20
_BLOCK = 1 << 20
_WRITTEN = (1980, 1, 1, 0, 0, 0)
"""The time of every member: the same library gives the same bytes."""


def write_archive(path: Path, entries: list[tuple[FolderEntry, Path]]) -> None:
    """Entries and their regnf field files. The file is there once it is whole."""
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
    """An archive whose structure was checked; its fields still have to pass the importer."""

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
            raise _refused(f"the field of {entry.notes.name!r} differs from the one in the index", "HASH_MISMATCH")


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
        hint = "Give a file that `regnf library export` wrote."
        raise InvalidInputError(f"{path}: not a library: it has no {INDEX}", reason="LIBRARY_INDEX_INVALID", hint=hint)
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

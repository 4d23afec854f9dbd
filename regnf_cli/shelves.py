"""Where the commands of ``regnf library`` keep a library: in a folder, or at a service."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from regnf_cli.extras import require
from regnf_client import Client, Entry
from regnf_core.field_source import FieldSource
from regnf_core.library_entries import EntryNotes
from regnf_core.library_folder import FolderEntry, LibraryFolder, digest_of


@dataclass(frozen=True)
class Shown:
    """An entry as the commands show it. place: of its field, a file or an address."""

    notes: EntryNotes
    field: str
    symmetry: dict[str, Any] | None
    place: str
    detected: dict[str, Any] | None = None
    state: str = "ready"

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        said = self.notes.symmetry is not None
        source = "said" if said else None if self.symmetry is None else "detected"
        values = self.notes.to_dict() | {"symmetry": self.symmetry, "symmetry_source": source}
        return values | {"field": self.field, "state": self.state, "place": self.place}


class Shelf(Protocol):
    """A library. Everything may raise RegnfError."""

    def entries(self, tag: str | None = None, part: str | None = None) -> list[Shown]: ...

    def get(self, name: str) -> Shown: ...

    def add(self, source: FieldSource, notes: EntryNotes) -> Shown: ...

    def change(self, name: str, notes: EntryNotes) -> Shown: ...

    def remove(self, name: str) -> None: ...

    def file(self, entry: Shown, folder: Path) -> Path:
        """The entry's safe field: where it lies, or written into ``folder``."""
        ...


class FolderShelf:
    """A library in a folder."""

    def __init__(self, folder: Path | None) -> None:
        self.library = LibraryFolder.usual() if folder is None else LibraryFolder(folder)

    def entries(self, tag: str | None = None, part: str | None = None) -> list[Shown]:
        return [self._shown(one) for one in self.library.entries(tag, part)]

    def get(self, name: str) -> Shown:
        return self._shown(self.library.get(name))

    def add(self, source: FieldSource, notes: EntryNotes) -> Shown:
        require("engine")
        return self._shown(self.library.add(source, notes))

    def change(self, name: str, notes: EntryNotes) -> Shown:
        return self._shown(self.library.change(name, notes))

    def remove(self, name: str) -> None:
        self.library.remove(name)

    def file(self, entry: Shown, folder: Path) -> Path:  # noqa: ARG002 -- it lies there already
        return Path(entry.place)

    def _shown(self, entry: FolderEntry) -> Shown:
        return Shown(entry.notes, entry.field, entry.symmetry, str(self.library.file(entry)), entry.detected)


class ServiceShelf:
    """A caller's library at a service."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def entries(self, tag: str | None = None, part: str | None = None) -> list[Shown]:
        return [self._shown(one) for one in self._client.library.entries(tag, part)]

    def get(self, name: str) -> Shown:
        return self._shown(self._client.library.get(name))

    def add(self, source: FieldSource, notes: EntryNotes) -> Shown:
        said = notes.to_dict()
        return self._shown(self._client.library.add(said.pop("name"), source, **said))

    def change(self, name: str, notes: EntryNotes) -> Shown:
        return self._shown(self._client.library.change(name, **notes.to_dict()))

    def remove(self, name: str) -> None:
        self._client.library.remove(name)

    def file(self, entry: Shown, folder: Path) -> Path:
        return self._client.library.download(entry.notes.name, folder / f"{entry.field}.safetensors")

    def _shown(self, entry: Entry) -> Shown:
        said = entry.symmetry_source == "said"
        notes = EntryNotes(entry.name, tuple(entry.tags), entry.unit, entry.note, entry.symmetry if said else None)
        place = f"{self._client.address}/fields/{entry.field}"
        return Shown(notes, entry.field, entry.symmetry, place, None if said else entry.symmetry, entry.state)


@contextmanager
def open_shelf(folder: Path | None, server: str | None, token: str | None) -> Iterator[Shelf]:
    """The library that a command means: that of a service, or of a folder."""
    if server is None:
        yield FolderShelf(folder)
        return
    with Client(server, token) as client:
        yield ServiceShelf(client)


@contextmanager
def files_of(shelf: Shelf, entries: list[Shown]) -> Iterator[list[tuple[FolderEntry, Path]]]:
    """Entries as an archive has them, with their safe fields."""
    with TemporaryDirectory(prefix="library-") as folder:
        files = [shelf.file(one, Path(folder)) for one in entries]
        yield [
            (FolderEntry(one.notes, digest_of(file), one.detected), file)
            for one, file in zip(entries, files, strict=True)
        ]

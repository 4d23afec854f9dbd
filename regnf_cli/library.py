"""``regnf library``: objects by name, in a folder of one's own or at a service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from regnf_cli.guard import require
from regnf_cli.options import (
    Config,
    Description,
    Field,
    NoConfig,
    Node,
    Token,
    choice_of,
    client_of,
    file,
    output_folder,
    source_of,
    with_node,
)
from regnf_cli.report import axis_in_words, out, say, tell
from regnf_core.errors import InvalidInputError
from regnf_core.field_source import FieldSource
from regnf_core.library_entries import EntryNotes
from regnf_core.library_folder import FolderEntry, LibraryFolder, digest_of, open_archive, write_archive
from regnf_core.texts import json_value

if TYPE_CHECKING:
    from regnf_client import Client, Entry

# Where the commands of ``regnf library`` keep a library: in a folder, or at a service.


@dataclass(frozen=True)
class Shown(FolderEntry):
    """An entry as the commands show it. place: of its field, a file or an address."""

    place: str = ""
    state: str = "ready"

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        source = "said" if self.notes.symmetry is not None else None if self.symmetry is None else "detected"
        values = self.notes.to_dict() | {"symmetry": self.symmetry, "symmetry_source": source}
        return values | {"field": self.field, "state": self.state, "place": self.place}


class Shelf:
    """A library: at a service, or in a folder. Everything may raise RegnfError."""

    def __init__(self, folder: LibraryFolder, client: Client | None) -> None:
        self._folder = folder
        self._client = client
        self._kept = folder if client is None else client.library

    def entries(self, tag: str | None = None, part: str | None = None) -> list[Shown]:
        return [self._shown(one) for one in self._kept.entries(tag, part)]

    def get(self, name: str) -> Shown:
        return self._shown(self._kept.get(name))

    def add(self, source: FieldSource, notes: EntryNotes) -> Shown:
        if self._client is None:
            require("engine")
            return self._shown(self._folder.add(source, notes))
        said = notes.to_dict()
        return self._shown(self._client.library.add(said.pop("name"), source, **said))

    def change(self, name: str, notes: EntryNotes) -> Shown:
        if self._client is None:
            return self._shown(self._folder.change(name, notes))
        return self._shown(self._client.library.change(name, **notes.to_dict()))

    def remove(self, name: str) -> None:
        self._kept.remove(name)

    def file(self, entry: Shown, folder: Path) -> Path:
        """The entry's regnf field file: where it lies; of a service, written into ``folder``."""
        if self._client is None:
            return Path(entry.place)
        return self._client.library.download(entry.notes.name, folder / f"{entry.field}.safetensors")

    def _shown(self, one: FolderEntry | Entry) -> Shown:
        if isinstance(one, FolderEntry):
            return Shown(one.notes, one.field, one.detected, str(self._folder.file(one)))
        said = one.symmetry_source == "said"
        notes = EntryNotes(one.name, tuple(one.tags), one.unit, one.note, one.symmetry if said else None)
        place = f"{self._client.address if self._client else ''}/fields/{one.field}"
        return Shown(notes, one.field, None if said else one.symmetry, place, one.state)


@contextmanager
def open_shelf(folder: Path | None, server: str | None, token: str | None) -> Iterator[Shelf]:
    """The library that a command means: that of a service, or of a folder."""
    with client_of(server, token) or nullcontext() as client:
        yield Shelf(LibraryFolder.usual() if folder is None else LibraryFolder(folder), client)


app = typer.Typer(
    help="Manage a library of objects: add, list, show, edit, remove, export, import.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)
_NONE = "none"
_DETECTED = "detected"

Name = Annotated[str, typer.Argument(help="The entry's name.")]
Folder = Annotated[
    Path | None,
    typer.Option(
        "--library",
        help="The library's folder. Default: $REGNF_LIBRARY, or your own library.",
        parser=output_folder,
        metavar="FOLDER",
    ),
]
Server = Annotated[
    str | None, typer.Option(help="Address of a regnf service. The command then uses your library there.")
]
Tags = Annotated[list[str] | None, typer.Option("--tag", help="A tag. Repeat the option for several tags.")]
Unit = Annotated[str | None, typer.Option(help="Unit of the field: m, cm, mm, in or ft.")]
Note = Annotated[str | None, typer.Option(help="A comment, one line.")]
Symmetry = Annotated[
    str | None,
    typer.Option(
        help='Symmetry instead of the detected one, JSON: {"order": 4, "axis": [0, 0, 1], "continuous": false}. '
        "none: the object has no symmetry. detected: use the detected one."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def add(
    name: Name,
    field: Field,
    tag: Tags = None,
    unit: Unit = None,
    note: Note = None,
    symmetry: Symmetry = None,
    description: Description = None,
    node: Node = None,
    config: Config = None,
    no_config: NoConfig = False,
    library: Folder = None,
    server: Server = None,
    token: Token = None,
) -> None:
    """Import a field as an object, detect its symmetry, and store it under a name.

    Example: **regnf library add "office chair" chair.glb --tag seat --unit m**
    """
    notes = EntryNotes.checked(name, tag or (), unit, note, _symmetry(symmetry))
    source = source_of(field, with_node(description, node), choice_of(config, no_config), "object")
    with open_shelf(library, server, token) as shelf:
        _show(shelf.add(source, notes))


@app.command("list")
def list_(
    tag: Annotated[str | None, typer.Option(help="Only entries with this tag.")] = None,
    name: Annotated[str | None, typer.Option(help="Only entries whose name contains this text.")] = None,
    library: Folder = None,
    server: Server = None,
    token: Token = None,
    as_json: AsJson = False,
) -> None:
    """List the library's objects.

    Example: **regnf library list --tag seat**
    """
    with open_shelf(library, server, token) as shelf:
        entries = shelf.entries(tag, name)
    if as_json:
        out.print_json(json.dumps([one.to_dict() for one in entries]))
        return
    table = Table("name", "tags", "unit", "symmetry", "field", box=None, header_style="bold")
    for one in entries:
        table.add_row(
            one.notes.name, ", ".join(one.notes.tags), one.notes.unit or "", _words(one.symmetry), one.field[:12]
        )
    out.print(table if entries else "no entries")


@app.command()
def show(
    name: Name, library: Folder = None, server: Server = None, token: Token = None, as_json: AsJson = False
) -> None:
    """Show one entry and the location of its field.

    Example: **regnf library show "office chair"**
    """
    with open_shelf(library, server, token) as shelf:
        entry = shelf.get(name)
    if as_json:
        out.print_json(json.dumps(entry.to_dict()))
    else:
        _show(entry)


@app.command()
def edit(
    name: Name,
    rename: Annotated[str | None, typer.Option(help="The new name.")] = None,
    tag: Tags = None,
    unit: Unit = None,
    note: Note = None,
    symmetry: Symmetry = None,
    library: Folder = None,
    server: Server = None,
    token: Token = None,
) -> None:
    """Change an entry. Options that are not given leave their value unchanged. `none` removes the unit, the note or all
    tags; `detected` restores the detected symmetry.

    Example: **regnf library edit "office chair" --rename armchair --symmetry detected**
    """
    with open_shelf(library, server, token) as shelf:
        known = shelf.get(name).notes
        tags = [] if tag == [_NONE] else tag
        said: dict[str, Any] = {"name": rename, "tags": tags, "unit": unit, "note": note}
        changes = {member: None if value == _NONE else value for member, value in said.items() if value is not None}
        if symmetry is not None:
            changes["symmetry"] = _symmetry(symmetry)
        _show(shelf.change(name, EntryNotes.checked(**(known.to_dict() | changes))))


@app.command()
def remove(name: Name, library: Folder = None, server: Server = None, token: Token = None) -> None:
    """Remove an entry from the library. A folder deletes its field too; a service keeps it.

    Example: **regnf library remove "office chair"**
    """
    with open_shelf(library, server, token) as shelf:
        shelf.remove(name)
    tell(f"removed {name}")


@app.command("export")
def export_(
    archive: Annotated[Path, typer.Argument(help="The .zip file to write.", metavar="ARCHIVE")],
    tag: Annotated[str | None, typer.Option(help="Only entries with this tag.")] = None,
    library: Folder = None,
    server: Server = None,
    token: Token = None,
) -> None:
    """Write the library into one file: an index and the regnf field files.

    Example: **regnf library export chairs.zip --tag seat**
    """
    with open_shelf(library, server, token) as shelf:
        entries = shelf.entries(tag)
        if not entries:
            hint = "`regnf library list` lists the entries."
            raise InvalidInputError("no entry to export", reason="LIBRARY_EMPTY", hint=hint)
        with TemporaryDirectory(prefix="library-") as folder:
            files = [(one, shelf.file(one, Path(folder))) for one in entries]
            write_archive(
                archive, [(FolderEntry(one.notes, digest_of(file), one.detected), file) for one, file in files]
            )
    counted = "1 entry" if len(entries) == 1 else f"{len(entries)} entries"
    tell(f"wrote {archive}: {counted}")


@app.command("import")
def import_(
    archive: Annotated[Path, typer.Argument(help="A file written by `export`.", parser=file, metavar="ARCHIVE")],
    skip_taken: Annotated[bool, typer.Option("--skip-taken", help="Skip entries whose names exist already.")] = False,
    library: Folder = None,
    server: Server = None,
    token: Token = None,
) -> None:
    """Add the entries of a file written by `export`. Each field is imported and checked again.

    Example: **regnf library import chairs.zip**
    """
    with open_archive(archive) as opened, open_shelf(library, server, token) as shelf, TemporaryDirectory() as folder:
        taken = {one.notes.name for one in shelf.entries()} & {one.notes.name for one in opened.entries}
        if taken and not skip_taken:
            message = f"{archive}: these entries exist already: {', '.join(map(repr, sorted(taken)[:5]))}"
            hint = "Rename or remove these entries, or skip those of the file with --skip-taken."
            raise InvalidInputError(message, reason="LIBRARY_NAME_TAKEN", hint=hint)
        wanted = [one for one in opened.entries if one.notes.name not in taken]
        for one in wanted:
            field = Path(folder) / f"{one.field}.safetensors"
            opened.extract(one, field)
            shelf.add(FieldSource(field, field), one.notes)
            field.unlink()
            tell(f"added {one.notes.name}")
    tell(f"{len(wanted)} added, {len(taken)} left out")


def _symmetry(text: str | None) -> Any:
    """What is said of it; None leaves the detected one."""
    if text in (None, _DETECTED):
        return None
    said = {"order": 1} if text == _NONE else json_value(text, "symmetry: ")
    return {"axis": None, "continuous": False} | said if isinstance(said, dict) else said


def _show(entry: Shown) -> None:
    notes = entry.notes
    said = {"symmetry": _words(entry.symmetry) + (" (as said)" if notes.symmetry is not None else "")}
    told = {"name": notes.name, "tags": ", ".join(notes.tags), "unit": notes.unit, "note": notes.note, **said}
    for word, value in (told | {"field": entry.place}).items():
        if value:
            say(f"{word:<9} {value}")


def _words(symmetry: dict[str, Any] | None) -> str:
    """A symmetry as people read it."""
    if symmetry is None:
        return "not known"
    axis = symmetry.get("axis")
    about = "" if axis is None else f" about {axis_in_words(axis)}"
    if symmetry["continuous"]:
        return f"every turn{about}"
    return f"{symmetry['order']} turns{about}" if symmetry["order"] > 1 else "none"

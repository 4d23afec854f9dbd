"""The objects of a search: entries of libraries by their names, and fields by their files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from regnf_cli.field_options import source_of
from regnf_core.errors import InvalidInputError
from regnf_core.field_source import FieldSource, SettingsChoice
from regnf_core.library_files import library_files
from regnf_core.library_folder import LibraryFolder


def objects_of(
    named: list[Path] | None, tag: str | None, description: Mapping[str, Any] | None, settings: SettingsChoice
) -> Iterator[FieldSource]:
    """What each path stands for; without any, the user's own library.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE), and what ``find_source`` does.
    """
    paths = named or [LibraryFolder.usual().folder]
    libraries = [LibraryFolder(path) for path in paths if not named or LibraryFolder.is_one(path)]
    entries = [(library, one) for library in libraries for one in library.entries(tag)]
    if libraries and not entries:
        which = "" if tag is None else f" with the tag {tag!r}"
        hint = "`regnf library add NAME FIELD` adds one; or name a folder of fields."
        raise InvalidInputError(f"{libraries[0].folder}: no entries{which}", reason="LIBRARY_EMPTY", hint=hint)
    for library, one in entries:
        yield FieldSource(Path(one.notes.name), library.file(one))
    files = [path for path in paths if path not in [library.folder for library in libraries]]
    for path in library_files(files) if files else ():
        yield source_of(path, description, settings, "object")

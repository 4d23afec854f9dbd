"""Files named at the command line: a name that cannot be used is refused with the one that was meant."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from regnf_core.errors import InvalidInputError, InvalidOptionsError
from regnf_core.field_files import require_field_file, require_file
from regnf_core.field_source import find_source
from regnf_core.files import RECORDING_SUFFIX, new_file


def field_path(text: str) -> Path:
    """The path of a field: of a file, a training run's folder or an archive. Raises what ``find_source`` does."""
    path = Path(text)
    find_source(path, settings=False)
    return path


def file(text: str) -> Path:
    """The path of a file that is there. Raises InvalidInputError (FILE_NOT_FOUND, FILE_IS_FOLDER)."""
    path = Path(text)
    require_file(path)
    return path


def folder(text: str) -> Path:
    """The path of a folder that is there. Raises InvalidInputError (FILE_NOT_FOUND, FILE_IS_NO_FOLDER)."""
    path = Path(text)
    if path.is_dir():
        return path
    if path.exists():
        hint = f"Give the folder that holds it: {path.parent}"
        raise InvalidInputError(f"{path}: a file, expected a folder", reason="FILE_IS_NO_FOLDER", hint=hint)
    require_file(path)
    return path


def existing(text: str) -> Path:
    """The path of a file or a folder that is there. Raises InvalidInputError (FILE_NOT_FOUND)."""
    path = Path(text)
    if not path.is_dir():
        require_file(path)
    return path


def library_path(text: str) -> Path:
    """A folder of fields, or a field. Raises what ``require_field_file`` does."""
    path = Path(text)
    if not path.is_dir():
        require_field_file(path)
    return path


def output_folder(text: str) -> Path:
    """The path of a folder to write into, which may not be there yet. Raises InvalidInputError (FILE_IS_NO_FOLDER)."""
    path = Path(text)
    for place in (path, *path.parents):
        if place.is_dir():
            break
        if place.exists():
            message = f"{place}: a file, expected a folder to write into"
            raise InvalidInputError(message, reason="FILE_IS_NO_FOLDER", hint="Name another folder.")
    return path


def check_output(output: Path, endings: Sequence[str], given: Iterable[Path | None] = ()) -> None:
    """Refuse, before the work, a file to write that cannot be written, or is one of those ``given`` to be read.

    endings: those that its name may have. Raises InvalidOptionsError.
    """
    if output.suffix.lower() not in endings:
        hint = "The ending chooses the format." if len(endings) > 1 else f"Write for example {output.stem}{endings[0]}."
        expected = f"one of {', '.join(endings)}" if len(endings) > 1 else endings[0]
        raise InvalidOptionsError(f"{output}: expected a name that ends in {expected}", hint=hint)
    if not output.parent.is_dir():
        raise InvalidOptionsError(f"{output.parent}: no such folder", hint=f"Make it: mkdir -p {output.parent}")
    if any(one is not None and one.exists() and output.exists() and output.samefile(one) for one in given):
        raise InvalidOptionsError(f"{output}: it is read, and would be overwritten", hint="Name another file to write.")


def recording_file(text: str) -> Path:
    """The path of a recording to write, whose folder may not be there yet.

    Raises InvalidOptionsError for a name of something else, InvalidInputError (FILE_IS_FOLDER, FILE_IS_NO_FOLDER).
    """
    path = Path(text)
    output_folder(str(path.parent))
    return new_file(path, RECORDING_SUFFIX)


FIELD: dict[str, Any] = {"parser": field_path, "metavar": "FIELD"}
JSON_FILE: dict[str, Any] = {"parser": file, "metavar": "FILE"}
OUTPUT: dict[str, Any] = {"parser": output_folder, "metavar": "FOLDER"}
RECORDING: dict[str, Any] = {"parser": recording_file, "metavar": "FILE"}
"""How options and arguments of these kinds are declared."""

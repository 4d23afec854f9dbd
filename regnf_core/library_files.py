"""The files of a library of objects, from the files and folders that a user names. Torch-free."""

from __future__ import annotations

from pathlib import Path

from regnf_core.errors import InvalidInputError
from regnf_core.field_files import checkpoint_below
from regnf_core.importing.containers.sniff import HEAD_BYTES, sniff_format

_MOST = 512


def library_files(named: list[Path]) -> list[Path]:
    """The files named, and those of the folders named that look like fields, each once, in order.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE).
    """
    files: dict[Path, Path] = {}
    for path in named:
        for file in _fields_in(path) if path.is_dir() else [path]:
            files.setdefault(file.resolve(), file)
    if not files:
        message = f"{', '.join(map(str, named))}: no fields in it, expected safe fields, checkpoints or meshes"
        hint = "Give the folder that holds the objects' files; folders inside it are not searched."
        raise InvalidInputError(message, reason="LIBRARY_EMPTY", hint=hint)
    if len(files) > _MOST:
        raise InvalidInputError(f"{len(files)} objects; at most {_MOST} are searched", reason="LIBRARY_TOO_LARGE")
    return list(files.values())


def _fields_in(folder: Path) -> list[Path]:
    """The fields that lie in a folder; the folder itself where it has none and is a training run's."""
    found = sorted(filter(_looks_like_a_field, folder.iterdir()))
    return found if found or checkpoint_below(folder) is None else [folder]


def _looks_like_a_field(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return sniff_format(file.read(HEAD_BYTES)) is not None

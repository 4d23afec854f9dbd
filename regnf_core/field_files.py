"""Files of fields before they are opened: which file was meant, and the bounds in a header. Torch-free."""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

from regnf_core.detections import Bounds
from regnf_core.errors import FieldFormatError, InvalidInputError
from regnf_core.importing.containers.sniff import HEAD_BYTES, explain_refusal, sniff_format

CHECKPOINT_SUFFIXES = frozenset({".ckpt", ".pt", ".pth", ".tar"})
_TEXT_SUFFIXES = frozenset({".yml", ".yaml", ".json", ".toml", ".txt", ".log"})
_MAX_DEPTH = 4
_MAX_ENTRIES = 5000
_MAX_NAME = 200
_MAX_HEADER = 1 << 20


def require_field_file(path: Path) -> None:
    """Raises InvalidInputError FILE_NOT_FOUND or FILE_IS_FOLDER, FieldFormatError as ``explain_refusal`` has it.

    Each names the path; for the folder of a training run and its config.yml, the hint names the checkpoint inside.
    """
    require_file(path)
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if sniff_format(head) is not None:
        return
    reason, message = explain_refusal(head, path.name)
    if path.suffix.lower() in _TEXT_SUFFIXES and reason != "FORMAT_NOT_SUPPORTED":
        found = checkpoint_below(path.parent)
        hint = f"Did you mean {found}?" if found else "Give the checkpoint to which it belongs."
        message = f"{path}: a text file ({path.suffix}), expected a field: regnf field file, checkpoint or mesh"
        raise FieldFormatError(message, reason="FORMAT_NOT_RECOGNIZED", hint=hint)
    raise FieldFormatError(f"{path}: {message}", reason=reason)


def require_file(path: Path) -> None:
    """Raises InvalidInputError, FILE_NOT_FOUND or FILE_IS_FOLDER, which names the path and the file that was meant."""
    if path.is_dir():
        found = checkpoint_below(path)
        hint = f"Did you mean {found}?" if found else "Give a file inside it."
        raise InvalidInputError(f"{path}: a folder, expected a file", reason="FILE_IS_FOLDER", hint=hint)
    if not path.exists():
        shown = str(path) if len(str(path)) <= _MAX_NAME else f"{str(path)[:_MAX_NAME]}..."
        raise InvalidInputError(f"{shown}: no such file", reason="FILE_NOT_FOUND", hint=_near(path))


def stored_bounds(path: Path) -> Bounds | None:
    """The lowest and the highest corner in a regnf field file's header; None where there is none to be read.

    It needs no library beyond Python's, and promises nothing: opening the file says what is wrong with it.
    """
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length)) if length <= _MAX_HEADER else {}
        lower, upper = json.loads(header["__metadata__"]["field"])["bounds"]
        corners = [[float(value) for value in corner] for corner in (lower, upper)]
    except (KeyError, TypeError, ValueError, RecursionError, OSError):
        return None
    return (corners[0], corners[1]) if len(corners[0]) == len(corners[1]) == 3 else None


def checkpoint_below(folder: Path) -> Path | None:
    """The checkpoint of the latest step in a training run's folder; None where there is none."""
    found = [path for path in _files(folder) if path.suffix.lower() in CHECKPOINT_SUFFIXES]

    def step(path: Path) -> int:
        return int([-1, *re.findall(r"\d{1,12}", path.stem)][-1])

    return max(found, key=lambda path: (step(path), path.stat().st_mtime, path.name), default=None)


def _files(folder: Path) -> Iterator[Path]:
    """The files below a folder, a few levels deep and a few thousand at most."""
    seen = 0
    base = len(folder.parts)
    for place, folders, names in os.walk(folder):
        if len(Path(place).parts) - base >= _MAX_DEPTH:
            folders.clear()
        for name in names:
            seen += 1
            if seen > _MAX_ENTRIES:
                return
            yield Path(place) / name


def _near(path: Path) -> str:
    """What to do about a file that is not there: the name that is almost the same, or where to look."""
    if str(path).lstrip()[:1] in ("{", "["):
        return "Write the JSON into a file, and give the path of the file."
    if re.match(r"[a-z][a-z0-9]+:/", str(path), re.IGNORECASE):
        return "URLs are not supported. Download the file, and give its path."
    folder = path.parent
    if not folder.is_dir():
        return f"There is no folder {str(folder)[:_MAX_NAME]} either. Check the path."
    names = [entry.name for entry in folder.iterdir()]
    same_stem = [name for name in names if Path(name).stem == path.stem]
    near = same_stem or difflib.get_close_matches(path.name, names, n=1)
    return f"Did you mean {folder / near[0]}?" if near else f"Check the path and the content of {folder.resolve()}."


# The files of a library of objects, from the files and folders that a user names. Torch-free.

_MOST = 512


def library_files(named: list[Path]) -> list[Path]:
    """The files named, and those of the folders named that look like fields, each once, in order.

    Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE).
    """
    files: dict[Path, Path] = {}
    for path in named:
        found = [path]
        if path.is_dir():  # its fields; itself where it has none and is a training run's
            fields = sorted(filter(_looks_like_a_field, path.iterdir()))
            found = fields if fields or checkpoint_below(path) is None else [path]
        for file in found:
            files.setdefault(file.resolve(), file)
    if not files:
        message = f"{', '.join(map(str, named))}: it has no fields; expected regnf field files, checkpoints or meshes"
        hint = "Give the folder with the objects' files. Its subfolders are not searched."
        raise InvalidInputError(message, reason="LIBRARY_EMPTY", hint=hint)
    if len(files) > _MOST:
        raise InvalidInputError(f"{len(files)} objects; a search can have at most {_MOST}", reason="LIBRARY_TOO_LARGE")
    return list(files.values())


def _looks_like_a_field(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return sniff_format(file.read(HEAD_BYTES)) is not None

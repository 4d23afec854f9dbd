"""All errors of regnf, each with a stable ``reason`` for programs.

    RegnfError
    ├── InvalidInputError            the caller can correct it
    │   ├── InvalidOptionsError      INVALID_OPTIONS, PRESET_UNSUITABLE
    │   ├── InvalidDetectionError    INVALID_DETECTION, DETECTION_OUTSIDE_SCENE
    │   ├── FieldFormatError         the bytes are no field we take: the reason says which stage refused them
    │   └── DatasetError             DATASET_...: a folder of posed images cannot be used
    ├── NoSurfaceError               NO_SURFACE_IN_DETECTION, NO_SURFACE_IN_OBJECT
    ├── InitializationError          NO_INITIAL_TRANSFORM
    ├── FitDivergedError             FIT_DIVERGED
    ├── MissingExtraError            EXTRA_MISSING
    └── CancelledError               CANCELLED

This module imports nothing heavy: the HTTP front end uses it without loading torch.
"""

from __future__ import annotations

import difflib
import errno
import os
import secrets
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# One of several functions that a file may stand for, where nothing in it tells which: what a person is asked.

MOST_CANDIDATES = 6
"""So many are shown at most, the most probable first."""


@dataclass(frozen=True)
class Candidate:
    """name: a few words that distinguish it · description: the import options that select it, to be added to the given
    ones · picture: a PNG with two views of its surface and a section, if it could be made."""

    name: str
    description: Mapping[str, Any]
    picture: bytes | None = None

    def added_to(self, said: Mapping[str, Any]) -> dict[str, Any]:
        """The complete import options that select this reading, with the options that were given."""
        return _merged(said, self.description)


@dataclass(frozen=True)
class Said:
    """The options of a user for a field. use: its role on a command line, scene or object, if it is known ·
    description: its entries, see UploadDescription."""

    use: str | None
    description: Mapping[str, Any]


def _merged(said: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    whole = dict(said)
    for name, value in more.items():
        held = whole.get(name)
        whole[name] = _merged(held, value) if isinstance(held, Mapping) and isinstance(value, Mapping) else value
    return whole


# What to do next, by the stable reason of an error or of a verdict; and the name that was meant.
#
# Command line, problem objects, result documents and page all show these. Torch-free.

_TEXTS: dict[str, dict[str, str]] = tomllib.loads(Path(__file__).with_name("hints.toml").read_text(encoding="utf-8"))
HINTS, _FAMILIES, VERDICT_REASONS, RENAMED = (_TEXTS[name] for name in ("hints", "families", "verdicts", "renamed"))
_LONGEST_COMPARED = 64
_MIN_SIMILARITY = 0.6


def hint_of(reason: str) -> str | None:
    """What the user can do next after an error with this reason; None if the message is sufficient."""
    family = next((hint for beginning, hint in _FAMILIES.items() if reason.startswith(beginning)), None)
    return HINTS.get(reason, family)


def verdict_hint(reason: str, options: Mapping[str, Any]) -> str:
    """What the user can do next after a verdict, with these options of the registration; "" if nothing is needed."""
    if reason == "SEVERAL_POSES_AGREE" and options.get("up_axis") is not None:
        return (
            "Choose one of the alternatives. All of them are upright. A box that includes the parts that distinguish "
            "the sides, or more views of the object, may decide."
        )
    return HINTS.get(reason, "")


def suggestion(name: str, known: Iterable[str]) -> str | None:
    """A hint for an unknown name: Did you mean `center`? None if no known name is similar."""
    near = nearest_name(name, known)
    return f"Did you mean `{near}`?" if near else None


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """The known name for an unknown one: its replacement, or the most similar name."""
    names = sorted(known)
    renamed = RENAMED.get(name)
    if renamed in names:
        return renamed
    by_lower = {one.lower(): one for one in reversed(names)}
    if len(name) > _LONGEST_COMPARED:
        return None
    near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=_MIN_SIMILARITY)
    return by_lower[near[0]] if near else None


class RegnfError(Exception):
    """Base of all errors raised by regnf.

    ``reason`` is a stable UPPER_SNAKE word; the message is for people and may change. ``hint`` says what to do next:
    the one given, else the usual one for the reason, else None.
    """

    reason: str = "INTERNAL"

    def __init__(self, message: str, *, reason: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        if reason is not None:
            self.reason = reason
        self._hint = hint

    @property
    def hint(self) -> str | None:
        return self._hint or hint_of(self.reason)


class InvalidInputError(RegnfError):
    """An input of the caller is invalid."""

    reason = "INVALID_INPUT"


class InvalidOptionsError(InvalidInputError):
    """An option is unknown, of the wrong type or out of its range."""

    reason = "INVALID_OPTIONS"


class InvalidDetectionError(InvalidInputError):
    """A detection box is malformed, or is outside the scene's bounds.

    ``place`` leads to the faulty member from the detection on: ("center", 0).
    """

    reason = "INVALID_DETECTION"

    def __init__(
        self, message: str, *, reason: str | None = None, hint: str | None = None, place: tuple[str | int, ...] = ()
    ) -> None:
        super().__init__(message, reason=reason, hint=hint)
        self.place = place


class FieldFormatError(InvalidInputError):
    """The bytes are not a field that regnf supports. ``reason`` identifies the stage and the error.

    candidates: the functions that a file may stand for, where that is why (LAYOUT_AMBIGUOUS). said: what the user
    said of the field, where that is known.
    """

    reason = "FIELD_NOT_RECOGNIZED"
    said: Said | None = None

    def __init__(
        self, message: str, *, reason: str | None = None, hint: str | None = None, candidates: Sequence[Candidate] = ()
    ) -> None:
        super().__init__(message, reason=reason, hint=hint)
        self.candidates = tuple(candidates)

    def told(self, message: str, hint: str | None = None) -> FieldFormatError:
        """The same error with another message."""
        error = FieldFormatError(message, reason=self.reason, hint=hint or self.hint, candidates=self.candidates)
        error.said = self.said
        return error


class DatasetError(InvalidInputError):
    """A folder of posed images cannot be read or written, or a scene cannot be rendered. ``reason`` tells the fault."""

    reason = "DATASET_INVALID"


class NoSurfaceError(RegnfError):
    """Too few surface points were found where the object should be."""

    reason = "NO_SURFACE_IN_DETECTION"


class InitializationError(RegnfError):
    """No initial transform could be estimated from the surface points."""

    reason = "NO_INITIAL_TRANSFORM"


class FitDivergedError(RegnfError):
    """The fit of a field has diverged to NaN or infinity. Its last checkpoint is kept."""

    reason = "FIT_DIVERGED"


class CancelledError(RegnfError):
    """The caller requested the work to stop."""

    reason = "CANCELLED"


class MissingExtraError(RegnfError):
    """A required extra of the package is not installed, or only in part."""

    unavailable = True
    reason = "EXTRA_MISSING"

    @classmethod
    def of(cls, modules: Sequence[str], extras: Sequence[str]) -> MissingExtraError:
        """Lists the missing modules, and the extras that install them."""
        return cls(f"not installed: {', '.join(modules)}; pip install 'regnf[{','.join(extras)}]'")


# Files that appear complete or not at all, and the names that they may have.

RECORDING_SUFFIX = ".rrd"
"""Suffix of recordings for the rerun viewer."""


@contextmanager
def atomic_path(path: str | os.PathLike[str], durable: bool = False) -> Iterator[Path]:
    """A temporary path next to ``path`` to write to. It is renamed to ``path`` at the end, or removed after an error.

    durable: the content is on the disk before the rename, so that a power failure leaves no incomplete file either.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(8)}.part")
    try:
        yield temporary
        if durable:
            with temporary.open("rb") as written:
                os.fsync(written.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def made_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Creates the folder and its parents, if they do not exist. After an error the new folders are removed again, if
    they are empty."""
    folder = Path(path)
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except BaseException:
        for one in missing:
            with suppress(OSError):
                one.rmdir()
        raise


@contextmanager
def filled_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder for new files. They are moved into the folder ``path`` at the end. After an error none of them
    is moved."""
    with made_folder(path) as target, tempfile.TemporaryDirectory(dir=target) as work:
        yield Path(work)
        for made in sorted(Path(work).iterdir()):
            made.replace(target / made.name)


def require_writable(folder: str | os.PathLike[str]) -> None:
    """Raises PermissionError unless the folder may be written into, or made. Nothing is made."""
    place = next(one for one in (Path(folder).absolute(), *Path(folder).absolute().parents) if one.exists())
    if not os.access(place, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))


def new_file(path: str | os.PathLike[str], suffix: str) -> Path:
    """The path of a file to write, whose name ends in ``suffix``.

    Raises InvalidOptionsError for another name, InvalidInputError (FILE_IS_FOLDER) where there is a folder.
    """
    target = Path(path)
    if target.is_dir():
        hint = f"Give a file in it: {target / 'result'}{suffix}"
        raise InvalidInputError(f"{target}: a folder, expected a file to write", reason="FILE_IS_FOLDER", hint=hint)
    if target.suffix != suffix:
        raise InvalidOptionsError(f"{target}: expected a name that ends in {suffix}")
    return target


def verdict_in_words(reason: str, limit: str = "") -> str:
    """The sentence of the reason and, if a limit was violated, the value and the limit."""
    said = VERDICT_REASONS.get(reason, "")
    return f"{said} {limit[:1].upper()}{limit[1:]}.".strip() if limit else said

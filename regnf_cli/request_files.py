"""The files that describe a registration at the command line: detection, options, transforms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from regnf_core.detections import Detection, parse_detection
from regnf_core.errors import InvalidDetectionError, InvalidInputError, InvalidOptionsError
from regnf_core.geometry.similarity_check import Rows, transform_rows
from regnf_core.options import Preset, RegistrationOptions
from regnf_core.texts import json_value

_TRANSFORM = 'Write {"T_object_scene": [[4 numbers], [4], [4], [0, 0, 0, 1]]}: scene coordinates to object coordinates;'
_TRANSFORM += ' or {"T_scene_object": ...}: object coordinates to scene coordinates.'


def read_detection(path: Path, index: int | None = None) -> Detection:
    """The detection in a file, in any form. Raises InvalidInputError (MALFORMED_JSON) and InvalidDetectionError."""
    try:
        return parse_detection(read_json(path, "detection"), index)
    except InvalidDetectionError as error:
        message = f"{path}: {error}"
        raise InvalidDetectionError(message, reason=error.reason, hint=error.hint, place=error.place) from error


def read_object(path: Path, what: str) -> dict[str, Any]:
    """A JSON object from a file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold."""
    value = read_json(path, what)
    if not isinstance(value, dict):
        hint = "Write an object: {...}."
        raise InvalidInputError(f"{what} {path}: expected a JSON object", reason="MALFORMED_JSON", hint=hint)
    return value


def read_list(path: Path, what: str) -> list[Any]:
    """A JSON list from a file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold."""
    value = read_json(path, what)
    if not isinstance(value, list):
        raise InvalidInputError(f"{what} {path}: expected a JSON list", reason="MALFORMED_JSON", hint="Write [...].")
    return value


def read_options(path: Path | None, preset: Preset | None) -> dict[str, Any]:
    """Plain options: those of a file, or none, with the preset that was asked for by name.

    Raises InvalidOptionsError when the file names another preset, or holds what is no option.
    """
    values = read_object(path, "options") if path else {}
    named = values.get("preset", preset)
    if preset is not None and named != preset:
        raise InvalidOptionsError(f"options.preset: {path} says {named!r}, --preset {preset}: leave one of them out")
    options = values | {"preset": named} if named is not None else values
    try:
        RegistrationOptions.from_dict(options)
    except InvalidOptionsError as error:
        source = f"{path}: " if path else ""
        hint = error.hint or "docs/api.md lists every option with its range."
        raise InvalidOptionsError(f"{source}{error}", reason=error.reason, hint=hint) from error
    return options


def read_transform(path: Path, what: str) -> Rows:
    """The 4x4 T_object_scene in a file: rows, a transform object, or a document with a T_object_scene of either kind,
    or with its inverse, T_scene_object.

    Raises InvalidInputError (INVALID_TRANSFORM) when there is none, or it is no similarity.
    """
    return as_transform(read_json(path, what), f"{what} {path}")


def as_transform(value: Any, what: str) -> Rows:
    """The same of a value. Raises InvalidInputError (INVALID_TRANSFORM), which begins with ``what``."""
    try:
        return transform_rows(value)
    except ValueError as error:
        raise InvalidInputError(f"{what}: {error}", reason="INVALID_TRANSFORM", hint=_TRANSFORM) from error


def is_json(text: str) -> bool:
    """Whether a text that stands where a file may be named is the JSON itself."""
    return text.lstrip().lstrip("\ufeff")[:1] in ("{", "[")


def read_json(path: Path, what: str) -> Any:
    """The value in a JSON file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold, OSError."""
    return json_value(path.read_bytes(), f"{what} {path}: ")

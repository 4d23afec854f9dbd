"""The files that describe a registration at the command line: detection, options, transforms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from regnf_core.errors import InvalidDetectionError, InvalidInputError, InvalidOptionsError
from regnf_core.geometry.similarity_check import similarity_fault
from regnf_core.options import Preset, RegistrationOptions

if TYPE_CHECKING:
    from regnf_core.geometry.box import OrientedBox

Rows = list[list[float]]


def read_object(path: Path, what: str) -> dict[str, Any]:
    """A JSON object from a file. Raises InvalidInputError (MALFORMED_JSON) naming what the file was to hold."""
    value = _read_json(path, what)
    if not isinstance(value, dict):
        raise InvalidInputError(f"{what} {path}: expected a JSON object", reason="MALFORMED_JSON")
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
    RegistrationOptions.from_dict(options)
    return options


def read_transform(path: Path, what: str) -> Rows:
    """The 4x4 T_object_scene in a file: rows, a transform object, or a document with a T_object_scene of either kind.

    Raises InvalidInputError (INVALID_TRANSFORM) when there is none, or it is no similarity.
    """
    value = _read_json(path, what)
    if isinstance(value, dict):
        value = value.get("T_object_scene", value)
    rows = value.get("matrix") if isinstance(value, dict) else value
    if rows is None:
        raise InvalidInputError(f"{what} {path}: no T_object_scene with a matrix", reason="INVALID_TRANSFORM")
    if fault := similarity_fault(rows):
        raise InvalidInputError(f"{what} {path}: {fault}", reason="INVALID_TRANSFORM")
    return [[float(number) for number in row] for row in rows]


def parse_detection(values: dict[str, Any]) -> OrientedBox:
    """A detection's JSON as a box. Raises InvalidDetectionError for what is missing, unknown or malformed."""
    from regnf_core.geometry.box import OrientedBox

    known = {"min", "max", "center", "size", "rotation_quaternion_xyzw", "label", "score"}
    if unknown := sorted(set(values) - known):
        raise InvalidDetectionError(f"detection holds unknown members: {', '.join(unknown)}")
    shared = {name: values[name] for name in ("label", "score") if values.get(name) is not None}
    try:
        if values.keys() & {"min", "max"}:
            if extra := sorted(values.keys() & {"center", "size", "rotation_quaternion_xyzw"}):
                raise InvalidDetectionError(f"detection holds corners and {', '.join(extra)}: either, not both")
            return OrientedBox.from_corners(values["min"], values["max"], **shared)
        quaternion = values.get("rotation_quaternion_xyzw") or (0.0, 0.0, 0.0, 1.0)
        return OrientedBox.from_quaternion(values["center"], values["size"], quaternion, **shared)
    except KeyError as error:
        raise InvalidDetectionError(f"detection lacks {error}") from error
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise InvalidDetectionError("detection must hold lists of three numbers") from error


def _read_json(path: Path, what: str) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{what} {path}: {error}", reason="MALFORMED_JSON") from error

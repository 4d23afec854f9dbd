"""The parameters of the node, as ROS passes them. No ROS.

Launch files and command lines pass them through YAML, which makes a boolean of y and a number of 0.03 or 1e-3. So
a parameter may have any type here, and each is read for what it is to mean.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from regnf_ros.poses import Matrix, scale_of

_AXIS = re.compile(r"\+?(?:axis[_ -]?)?([xyz])(?:[_ -]?axis)?", re.IGNORECASE)
_ENTRY = re.compile(r"\s*(.+?)\s*=\s*([0-9a-fA-F]{64})(?:[\s,;]+|$)", re.DOTALL)
_DIGEST = re.compile(r"[0-9a-fA-F]{64}")
METERS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Of the units that an object may be in."""
KNOWN = 0.01
"""By what share the scale of a unit that is said may be off, as in the service."""
TOKEN_VARIABLE = "REGNF_API_TOKEN"  # noqa: S105 - the variable's name


def text_of(name: str, value: Any) -> str:
    """A text. Raises ValueError where YAML has made something else of it: what was written is lost then."""
    if isinstance(value, str):
        return value.strip()
    raise ValueError(f"{name}: expected a text, but YAML reads {value!r}; put it into quotes: {name}:=\"'...'\"")


def axis_of(name: str, value: Any) -> str:
    """x, y or z; "" where none is given. A true is the y that YAML has taken for yes. Raises ValueError."""
    if value is True:
        return "y"
    if value == "" and isinstance(value, str):
        return ""
    found = _AXIS.fullmatch(value.strip()) if isinstance(value, str) else None
    if found is None:
        raise ValueError(f"{name}: {value!r} is not x, y or z")
    return found[1].lower()


def share_of(name: str, value: Any) -> float | None:
    """A number of at least 0 and less than 1, also as a text; None for "". Raises ValueError."""
    if value == "" and isinstance(value, str):
        return None
    try:
        share = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        share = float("nan")
    if not 0.0 <= share < 1.0:
        raise ValueError(f"{name}: {value!r} is not a number from 0 to below 1, such as 0.03")
    return share


def objects_of(value: Any) -> dict[str, str]:
    """The SHA-256 of each class' field: of a list of texts CLASS=SHA256, of such texts in one, one behind the other, or
    of JSON, a list of them or {"CLASS": "SHA256"}.

    A class may have any name, with blanks, commas and signs of equality. Raises ValueError for an entry that is none,
    or a class that comes twice.
    """
    if isinstance(value, str) and value.lstrip()[:1] in ("{", "["):
        try:
            value = json.loads(value, object_pairs_hook=list)
        except ValueError as error:
            raise ValueError(f"objects: not valid JSON: {error}") from error
        value = ["=".join(map(str, one)) if isinstance(one, (list, tuple)) else one for one in value]
    entries = _entries(value) if isinstance(value, str) else value
    if not isinstance(entries, (list, tuple)):
        raise ValueError(f"objects: {value!r} is not a list of CLASS=SHA256")
    table: dict[str, str] = {}
    for entry in entries:
        name, sign, digest = str(entry).rpartition("=")
        name, digest = name.strip(), digest.strip()
        if not (name and sign and _DIGEST.fullmatch(digest)) or name in table:
            raise ValueError(f"objects: {entry!r} is not CLASS=SHA256 (64 hex digits), or has a class twice")
        table[name] = digest.lower()
    return table


def _entries(text: str) -> list[str]:
    """Each ends with 64 hexadecimal digits: what lies between two of them is a name, whatever is in it."""
    found, at = [], 0
    while at < len(text) and (entry := _ENTRY.match(text, at)):
        found.append(f"{entry[1]}={entry[2]}")
        at = entry.end()
    return [*found, text[at:]] if text[at:].strip() else found


def unit_of(name: str, value: Any) -> str:
    """The unit of the objects' fields: auto, free, or one of a known length. Raises ValueError."""
    if value in ("auto", "free", *METERS):
        return str(value)
    raise ValueError(f"{name}: {value!r} is not one of auto, free, {', '.join(METERS)}")


def options_of(up_axis: str, scale_tolerance: float | None, object_unit: str, T_scene_map: Matrix) -> dict[str, Any]:
    """The options of every registration. scale_tolerance: by what share the objects' units may differ from what
    ``object_unit`` says, or from meters where it says nothing; None: as the service takes a known unit, if it is known.
    """
    options: dict[str, Any] = {"up_axis": up_axis} if up_axis else {}
    robust: dict[str, Any] = {} if object_unit == "auto" else {"object_unit": object_unit}
    scale = scale_of(T_scene_map)
    if scale_tolerance is None and object_unit in METERS and abs(scale - 1.0) > KNOWN:
        scale_tolerance = KNOWN  # of a scene that is not in meters the service cannot tell
    if scale_tolerance is not None and object_unit != "free":
        units = 1.0 / (scale * METERS.get(object_unit, 1.0))
        robust |= {"min_scale": (1.0 - scale_tolerance) * units, "max_scale": (1.0 + scale_tolerance) * units}
    return options | ({"robust": robust} if robust else {})


def token_of(file: str, environment: Mapping[str, str] = os.environ) -> str:
    """The service's token: that in the file, or of the variable REGNF_API_TOKEN; "" for none.

    It is no parameter: every node of the graph can read those. Raises ValueError for a file that cannot be read.
    """
    if not file:
        return environment.get(TOKEN_VARIABLE, "").strip("\ufeff \t\r\n")
    try:
        raw = Path(file).read_bytes()
        return raw.decode(json.detect_encoding(raw)).strip("\ufeff \t\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"token_file: {file} cannot be read: {error}") from error

"""What a safe field file says about its tensors: which function they parametrize, and which shapes they must have.

Torch-free: the import gate writes descriptions and the worker's parent reads them without loading torch.
"""

from __future__ import annotations

import functools
import math
from typing import Any

from pydantic import TypeAdapter, ValidationError

from regnf_core.errors import FieldFormatError
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.kinds import KINDS

_MAX_DEPTH = 32


def parse_description(values: Any) -> FieldDescription:
    """The description from plain (JSON) values, of the kind that its ``kind`` names.

    Raises FieldFormatError: FIELD_KIND_UNKNOWN, or SAFE_FORMAT_INVALID naming the first faulty entry.
    """
    if not isinstance(values, dict):
        raise FieldFormatError("the field's description is not a JSON object", reason="SAFE_FORMAT_INVALID")
    if not _is_flat(values):
        raise FieldFormatError(f"the description nests deeper than {_MAX_DEPTH}", reason="SAFE_FORMAT_INVALID")
    name = values.get("kind")
    described = KINDS.get(name) if isinstance(name, str) else None
    if described is None:
        hint = " (did you mean `kind` where it says `family`?)" if name is None and "family" in values else ""
        raise FieldFormatError(f"unknown kind of field {name!r}{hint}", reason="FIELD_KIND_UNKNOWN")
    try:
        description = _adapter(described).validate_python(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise FieldFormatError(f"description.{where}: {first['msg']}", reason="SAFE_FORMAT_INVALID") from error
    inner = [] if description.placement is None else [("placement.bounds", description.placement.bounds)]
    for name, (lower, upper) in [("bounds", description.bounds), *inner]:
        if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(lower, upper, strict=True)):
            raise FieldFormatError(f"description.{name}: not a finite, non-empty box", reason="SAFE_FORMAT_INVALID")
    return description


def _is_flat(values: dict[str, Any]) -> bool:
    """Whether no value lies deeper than ``_MAX_DEPTH``: what is parsed must be written again, and read by others."""
    level: list[Any] = [values]
    for _ in range(_MAX_DEPTH):
        inner = (value.values() if isinstance(value, dict) else value for value in level)
        level = [value for values in inner for value in values if isinstance(value, dict | list | tuple)]
        if not level:
            return True
    return False


def description_to_dict(description: FieldDescription) -> dict[str, Any]:
    """Plain (JSON) values of a description, defaults included, in a fixed order."""
    values: dict[str, Any] = _adapter(type(description)).dump_python(description, mode="json")
    for name in ("placement", "inverse_deviation", "color"):
        if values[name] is None:
            del values[name]  # readers of before it take all other files
    return values


@functools.cache
def _adapter(described: type[FieldDescription]) -> TypeAdapter[FieldDescription]:
    return TypeAdapter(described)

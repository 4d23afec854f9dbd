"""regnf's own field file: safetensors with a JSON description. Nothing in it can run, and every shape is checked first.

Torch-free: :func:`regnf_core.fields.build.open_field` makes a field of it. The format is in docs/safe-format.md.
"""

from __future__ import annotations

import functools
import json
import math
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open

from regnf_core.errors import FieldFormatError, atomic_path
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.kinds import KINDS
from regnf_core.schema.tensor_check import TensorSpec

if TYPE_CHECKING:
    from numpy.typing import NDArray


# What a regnf field file says about its tensors: which function they parametrize, and which shapes they must have.
#
# Torch-free: the importer writes descriptions and the worker's parent reads them without loading torch.

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
        hint = " (did you mean `kind` instead of `family`?)" if name is None and "family" in values else ""
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


def prepare_kinds() -> None:
    """Build now what checks descriptions, which takes milliseconds a kind: forked processes find it built."""
    for described in KINDS.values():
        _adapter(described)


@functools.cache
def _adapter(described: type[FieldDescription]) -> TypeAdapter[FieldDescription]:
    return TypeAdapter(described)


FORMAT_VERSION = "2"
_TYPE_NAMES = {"float32": "F32", "float16": "F16", "int32": "I32"}
_ALIGNMENT = 64
_MAX_DESCRIPTION = 1 << 20


def write_safe_field(
    path: str | os.PathLike[str], description: dict[str, Any], tensors: Mapping[str, NDArray[Any]], room: int = 0
) -> None:
    """Write a field file atomically: a temporary file beside ``path`` is renamed once it is on the disk.

    The same description and tensors give the same bytes. description: see docs/safe-format.md · tensors: float32,
    float16 or int32 arrays by name · room: bytes that ``add_to_source`` may need. Raises FieldFormatError:
    SAFE_FORMAT_INVALID, FIELD_KIND_UNKNOWN, FIELD_SHAPES_MISMATCH or FIELD_NOT_FINITE.
    """
    parsed = parse_description(description)
    specs = tensor_specs(tensors)
    parsed.check(specs)
    for name, array in tensors.items():
        if not np.isfinite(array).all():
            raise FieldFormatError(f"{name} holds a number that is not finite", reason="FIELD_NOT_FINITE")
    # The table first: its rows are read as wide elements, which needs an aligned start.
    order = sorted(tensors, key=lambda name: (-tensors[name].itemsize, name != "hash_table", name))
    header = _header(description_to_dict(parsed), specs, order, tensors, room)
    with atomic_path(path, durable=True) as temporary, temporary.open("xb") as file:
        file.write(len(header).to_bytes(8, "little") + header)
        for name in order:
            file.write(
                np.ascontiguousarray(tensors[name]).astype(tensors[name].dtype.newbyteorder("<"), copy=False).data
            )


def add_to_source(path: str | os.PathLike[str], notes: Mapping[str, Any]) -> None:
    """Add ``notes`` to the entry ``source`` of a field file that was written with room for it, in place.

    Raises FieldFormatError (SAFE_FORMAT_INVALID) where there is not enough room.
    """
    with open(path, "r+b") as file:
        length = int.from_bytes(file.read(8), "little")
        entries = json.loads(file.read(length))
        field = json.loads(entries["__metadata__"]["field"])
        field["source"] = {**field.get("source", {}), **notes}
        entries["__metadata__"]["field"] = json.dumps(field, allow_nan=False, ensure_ascii=False)
        text = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
        if len(text) > length:
            raise FieldFormatError("the field file cannot store more notes", reason="SAFE_FORMAT_INVALID")
        file.seek(8)
        file.write(text.ljust(length))


def tensor_specs(tensors: Mapping[str, NDArray[Any]]) -> dict[str, TensorSpec]:
    """Shapes and types of arrays. Raises FieldFormatError (SAFE_FORMAT_INVALID) for a type that no field file holds."""
    return {name: TensorSpec(array.shape, _type_name(name, array)) for name, array in tensors.items()}


def read_description(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The description of the field in ``path``, from the file's header alone, checked against the tensors' shapes.

    Raises FieldFormatError: SAFE_FORMAT_INVALID, SAFE_FORMAT_VERSION, FIELD_KIND_UNKNOWN or FIELD_SHAPES_MISMATCH.
    """
    return description_to_dict(read_header(path)[0])


def read_header(path: str | os.PathLike[str]) -> tuple[FieldDescription, list[str]]:
    """The checked description, and the names of the tensors. Raises what :func:`read_description` raises."""
    try:
        with safe_open(os.fspath(path), framework="numpy") as file:
            metadata = file.metadata() or {}
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            specs = {name: TensorSpec(tuple(s.get_shape()), s.get_dtype()) for name, s in slices.items()}
    except SafetensorError as error:
        raise FieldFormatError(f"not a safetensors file: {error}", reason="SAFE_FORMAT_INVALID") from error
    description = _parse_metadata(metadata)
    description.check(specs)
    return description, sorted(specs)


def _parse_metadata(metadata: Mapping[str, str]) -> FieldDescription:
    version, text = metadata.get("regnf"), metadata.get("field")
    if version is None or text is None:
        raise FieldFormatError("a safetensors file, but not a regnf field", reason="SAFE_FORMAT_INVALID")
    if version != FORMAT_VERSION:
        raise FieldFormatError(f"field format version {version[:20]!r} is not known", reason="SAFE_FORMAT_VERSION")
    if len(text) > _MAX_DESCRIPTION:
        raise FieldFormatError("the field's description is too long", reason="SAFE_FORMAT_INVALID")
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FieldFormatError("the field's description is not JSON", reason="SAFE_FORMAT_INVALID") from error
    return parse_description(values)


def _header(
    description: dict[str, Any],
    specs: dict[str, TensorSpec],
    order: list[str],
    tensors: Mapping[str, NDArray[Any]],
    room: int,
) -> bytes:
    """The safetensors header, padded by ``room`` and so that the data starts aligned."""
    field = json.dumps(description, allow_nan=False, ensure_ascii=False)
    if len(field) > _MAX_DESCRIPTION:
        raise FieldFormatError("the field's description is too long", reason="SAFE_FORMAT_INVALID")
    entries: dict[str, Any] = {"__metadata__": {"regnf": FORMAT_VERSION, "field": field}}
    start = 0
    for name in order:
        end = start + tensors[name].nbytes
        entries[name] = {"dtype": specs[name].dtype, "shape": list(specs[name].shape), "data_offsets": [start, end]}
        start = end
    text = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
    return text + b" " * (room + -(len(text) + room + 8) % _ALIGNMENT)


def _type_name(name: str, array: NDArray[Any]) -> str:
    type_name = _TYPE_NAMES.get(array.dtype.name)
    if type_name is None:
        message = f"{name} is {array.dtype}, expected float32, float16 or int32"
        raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")
    return type_name

"""regnf's own regnf field file, uploaded again: checked like anything else, then written again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.field_notes import ASSUMED, WARNINGS, kept_assumptions, kept_warnings
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.assumptions import PLACES
from regnf_core.importing.containers.safetensors_header import StoredTensor, read_header
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import refuse_other_entries, require_family
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.description import COLOR, OBSERVATION, split_color
from regnf_core.schema.safe_format import read_description

FAMILY = "regnf"
_OF_THE_IMPORT = frozenset({"family", "frame", "dataset_transform", "accept_implausible", "as", "cameras", "color"})
"""Entries that no field file has."""
_OVERRULED = frozenset({"contraction", "level_mask"})
_TYPES: dict[str, np.dtype[Any]] = {"F32": np.dtype("<f4"), "F16": np.dtype("<f2"), "I32": np.dtype("<i4")}


def convert_safe_field(path: Path, data: memoryview, tensor_bytes: int, overrides: UploadDescription) -> ConvertedField:
    """The field in ``data``, the mapped bytes of ``path``, with what ``overrides`` overrides.

    Raises FieldFormatError: the SAFETENSORS_* reasons, SAFE_FORMAT_INVALID, SAFE_FORMAT_VERSION, TENSOR_*,
    FIELD_KIND_UNKNOWN, FIELD_SHAPES_MISMATCH or FIELD_NOT_FINITE.
    """
    header = read_header(data)
    if sum(tensor.size for tensor in header.values()) > tensor_bytes:
        raise FieldFormatError("the tensors exceed the limit", reason="TENSOR_TOO_LARGE")
    description = _overruled(read_description(path), overrides)
    tensors = {name: _array(name, tensor, data) for name, tensor in header.items()}
    why: tuple[str, ...] = ("a regnf field file",)
    if description.get(OBSERVATION) is not None:
        why += ("it has an observation",)
    if overrides.color.keep is False:
        description = {name: value for name, value in description.items() if name != COLOR}
        tensors = split_color(tensors)[0]
    source = dict(description["source"])
    warnings = kept_warnings(source.pop(WARNINGS, None))  # the import writes them again
    assumes = kept_assumptions(source.pop(ASSUMED, None))
    return ConvertedField(FAMILY, why, description | {"source": source}, tensors, warnings, assumes=assumes or PLACES)


def _overruled(description: dict[str, Any], overrides: UploadDescription) -> dict[str, Any]:
    """``description`` with what was said instead; a new scale takes the bounds along, unless they were said too."""
    require_family(overrides, FAMILY)
    refuse_other_entries(
        overrides, f"a field file of the kind {description['kind']}", sorted(_OVERRULED & description.keys())
    )
    said = overrides.non_default()
    placement = description.get("placement")
    changed = description | {name: value for name, value in said.items() if name not in _OF_THE_IMPORT}
    ratio = changed["world_scale"] / description["world_scale"]
    if overrides.bounds is None:
        changed["bounds"] = _times(ratio, description["bounds"])
    if placement is None:
        return changed
    if {"bounds", "frame"} & said.keys():
        message = (
            "the frame of the field is fixed (that of its dataset, or far from the origin), so its bounds cannot "
            "be changed"
        )
        raise FieldFormatError(f"description: {message}", reason="INVALID_DESCRIPTION")
    rows = [[*row[:3], ratio * row[3]] for row in placement["transform"][:3]] + [placement["transform"][3]]
    return changed | {"placement": {"transform": rows, "bounds": _times(ratio, placement["bounds"])}}


def _times(ratio: float, corners: list[list[float]]) -> list[list[float]]:
    return [[ratio * value for value in corner] for corner in corners]


def _array(name: str, tensor: StoredTensor, data: memoryview) -> StoredArray:
    stored = _TYPES.get(tensor.dtype)
    if stored is None:
        raise FieldFormatError(f"{name} is stored as {tensor.dtype}", reason="TENSOR_DTYPE")
    raw = data[tensor.offset : tensor.offset + tensor.size]
    values = np.frombuffer(raw, dtype=stored).reshape(tensor.shape)
    return values.astype(np.int32) if tensor.dtype == "I32" else np.asarray(values, dtype=np.float32)

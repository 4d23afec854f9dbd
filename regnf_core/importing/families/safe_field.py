"""regnf's own safe field file, uploaded again: checked like anything else, then written anew."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.fields.safe_format import read_description
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.safetensors_header import StoredTensor, read_header
from regnf_core.importing.tensors import Float32Array
from regnf_core.importing.upload_description import UploadDescription

_TYPES: dict[str, np.dtype[Any]] = {"F32": np.dtype("<f4"), "F16": np.dtype("<f2")}


def convert_safe_field(path: Path, data: memoryview, tensor_bytes: int, wanted: UploadDescription) -> ConvertedField:
    """The field in ``data``, the mapped bytes of ``path``, with what ``wanted`` overrides.

    Raises FieldFormatError: the SAFETENSORS_* reasons, SAFE_FORMAT_INVALID, SAFE_FORMAT_VERSION, TENSOR_*,
    FIELD_FAMILY_UNKNOWN, FIELD_SHAPES_MISMATCH or FIELD_NOT_FINITE.
    """
    header = read_header(data)
    if sum(tensor.size for tensor in header.values()) > tensor_bytes:
        raise FieldFormatError("the tensors exceed the limit", reason="TENSOR_TOO_LARGE")
    description = read_description(path)
    named = {"contraction": wanted.contraction, "level_mask": wanted.level_mask, "label": wanted.label}
    description |= {key: value for key, value in named.items() if value is not None}
    if any(value is not None for value in dataclasses.asdict(wanted.hash).values()):
        raise FieldFormatError("a field file describes its own hash grid", reason="INVALID_DESCRIPTION")
    if wanted.family not in (None, description["family"]):
        raise FieldFormatError(f"the file holds a {description['family']} field", reason="FAMILY_NOT_SUPPORTED")
    tensors = {name: _array(name, tensor, data) for name, tensor in header.items()}
    why = ("a regnf field file",)
    return ConvertedField(str(description["family"]), why, description, tensors)


def _array(name: str, tensor: StoredTensor, data: memoryview) -> Float32Array:
    stored = _TYPES.get(tensor.dtype)
    if stored is None:
        raise FieldFormatError(f"{name} is stored as {tensor.dtype}", reason="TENSOR_DTYPE")
    raw = data[tensor.offset : tensor.offset + tensor.size]
    return np.asarray(np.frombuffer(raw, dtype=stored).reshape(tensor.shape), dtype=np.float32)

"""The header of a safetensors file, checked in full before any library reads it.

Layout: 8 bytes length N, N bytes of JSON {name: {dtype, shape, data_offsets}}, then the tensors, end to end. Every byte
behind the header must belong to exactly one tensor.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from regnf_core.errors import FieldFormatError

MAX_HEADER_BYTES = 1 << 20
MAX_TENSORS = 1024
_MAX_DIMENSIONS = 8
_MAX_NAME = 256
_ITEM_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}


@dataclass(frozen=True)
class StoredTensor:
    """A tensor's place: ``size`` bytes at ``offset`` from the file's start."""

    dtype: str
    shape: tuple[int, ...]
    offset: int
    size: int


def read_header(data: memoryview) -> dict[str, StoredTensor]:
    """The tensors by name. ``data`` is the whole file, usually a memory map.

    Raises FieldFormatError: FILE_TRUNCATED, SAFETENSORS_HEADER_TOO_LARGE, SAFETENSORS_HEADER_MALFORMED,
    SAFETENSORS_DUPLICATE_KEY, SAFETENSORS_TOO_MANY_TENSORS, SAFETENSORS_LAYOUT or TENSOR_DTYPE.
    """
    if len(data) < 8:
        raise FieldFormatError("the file ends within its header", reason="FILE_TRUNCATED")
    length = int.from_bytes(data[:8], "little")
    if length > MAX_HEADER_BYTES:
        raise FieldFormatError(f"the header has {length} bytes", reason="SAFETENSORS_HEADER_TOO_LARGE")
    if 8 + length > len(data):
        raise FieldFormatError("the file ends within its header", reason="FILE_TRUNCATED")
    header = _parse(bytes(data[8 : 8 + length]))
    _check_metadata(header.pop("__metadata__", {}))
    if len(header) > MAX_TENSORS:  # none is right for a model whose few numbers are all constants
        raise FieldFormatError(f"{len(header)} tensors", reason="SAFETENSORS_TOO_MANY_TENSORS")
    tensors = {name: _tensor(name, entry, 8 + length) for name, entry in header.items()}
    _check_tiling(tensors, 8 + length, len(data))
    return tensors


def _malformed(message: str) -> FieldFormatError:
    return FieldFormatError(message, reason="SAFETENSORS_HEADER_MALFORMED")


def _parse(text: bytes) -> dict[str, Any]:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        values = dict(pairs)
        if len(values) != len(pairs):
            raise FieldFormatError("the header names something twice", reason="SAFETENSORS_DUPLICATE_KEY")
        return values

    try:
        header = json.loads(text.decode("utf-8"), object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        raise _malformed("the header is not JSON") from error
    if not isinstance(header, dict):
        raise _malformed("the header is not a JSON object")
    return header


def _check_metadata(metadata: object) -> None:
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise _malformed("the header's metadata are not text")


def _tensor(name: str, entry: object, base: int) -> StoredTensor:
    if not name.isprintable() or len(name) > _MAX_NAME:
        raise _malformed("a tensor's name is not plain text")
    match entry:
        case {"dtype": str() as dtype, "shape": list() as shape, "data_offsets": [begin, end], **rest} if not rest:
            numbers = [*shape, begin, end]
            if len(shape) <= _MAX_DIMENSIONS and all(type(n) is int and 0 <= n < 1 << 48 for n in numbers):
                if dtype not in _ITEM_BYTES:
                    raise FieldFormatError(f"{name[:80]} is stored as {dtype[:16]}", reason="TENSOR_DTYPE")
                if end - begin == math.prod(shape) * _ITEM_BYTES[dtype]:
                    return StoredTensor(dtype, tuple(shape), base + begin, end - begin)
                raise FieldFormatError(f"{name[:80]} has another size than its shape", reason="SAFETENSORS_LAYOUT")
    raise _malformed(f"the entry of {name[:80]} is invalid")


def _check_tiling(tensors: dict[str, StoredTensor], start: int, end: int) -> None:
    expected = start
    for tensor in sorted(tensors.values(), key=lambda t: (t.offset, t.size)):
        if tensor.offset != expected:
            word = "overlap" if tensor.offset < expected else "leave a hole"
            raise FieldFormatError(f"tensors {word}", reason="SAFETENSORS_LAYOUT")
        expected += tensor.size
    if expected > end:
        raise FieldFormatError("the file ends within a tensor", reason="FILE_TRUNCATED")
    if expected < end:
        raise FieldFormatError("the file has bytes that belong to no tensor", reason="SAFETENSORS_LAYOUT")

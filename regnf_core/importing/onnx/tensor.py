"""Tensors of an ONNX model: only such whose numbers stand in the file itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.onnx import wire

_DIMS, _TYPE, _FLOATS, _INT32S, _INT64S, _NAME, _RAW, _DOUBLES, _EXTERNAL, _LOCATION = 1, 2, 4, 5, 7, 8, 9, 10, 13, 14
_RAW_TYPES = {1: "<f4", 2: "<u1", 3: "<i1", 6: "<i4", 7: "<i8", 9: "?", 10: "<f2", 11: "<f8"}
_FLOAT_FIELDS = {1: _FLOATS, 11: _DOUBLES}
_MAX_DIMENSIONS = 8
_MAX_ITEMS = 1 << 32
_LARGEST = np.finfo(np.float32).max

Array = npt.NDArray[Any]


def read_tensor(data: memoryview) -> tuple[str, Array]:
    """Name and values: float32, int64 or bool. Raises FieldFormatError: ONNX_MALFORMED, ONNX_EXTERNAL_DATA,
    TENSOR_DTYPE or TENSOR_NOT_FINITE.
    """
    message = wire.read_message(data)
    name, shape, kind = wire.text(message, _NAME), wire.integers(message, _DIMS), wire.integer(message, _TYPE)
    if message.get(_EXTERNAL) or wire.integer(message, _LOCATION) != 0:
        text = "the model keeps weights in another file: export it whole (external_data=False)"
        raise FieldFormatError(text, reason="ONNX_EXTERNAL_DATA")
    # An axis of no length does not make the others harmless: numpy counts it as one.
    if len(shape) > _MAX_DIMENSIONS or any(n < 0 for n in shape) or math.prod(max(n, 1) for n in shape) > _MAX_ITEMS:
        raise wire.malformed("a tensor of a shape that no weight has")
    if kind not in _RAW_TYPES:
        raise FieldFormatError(f"an ONNX tensor of type {kind}; real numbers are needed", reason="TENSOR_DTYPE")
    values = _values(message, kind)
    if values.size != math.prod(shape):
        raise wire.malformed(f"a tensor of {math.prod(shape)} numbers holds {values.size}")
    return name, _in_our_types(values.reshape(shape))


def _values(message: wire.Message, kind: int) -> Array:
    stored = np.dtype(_RAW_TYPES[kind])
    raw = wire.messages(message, _RAW)
    if raw:
        if len(raw[-1]) % stored.itemsize:
            raise wire.malformed("a tensor that ends within a number")
        return np.frombuffer(raw[-1], dtype=stored)
    if kind in _FLOAT_FIELDS:
        whole = b"".join(bytes(value) for value in wire.messages(message, _FLOAT_FIELDS[kind]))
        return np.frombuffer(whole[: len(whole) // stored.itemsize * stored.itemsize], dtype=stored)
    numbers = np.array(wire.integers(message, _INT64S if kind == 7 else _INT32S), dtype=np.int64)
    return numbers.astype(np.uint16).view(np.float16) if stored.kind == "f" else numbers.astype(stored)


def _in_our_types(values: Array) -> Array:
    if values.dtype.kind == "b":
        return values
    if values.dtype.kind in "iu":
        return values.astype(np.int64)
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(values, dtype=np.float32)
    if np.isnan(single).any():
        raise FieldFormatError("an ONNX tensor holds NaN or an infinity", reason="TENSOR_NOT_FINITE")
    # an infinite bound of a clamp, or where a maximum starts: no safe file holds it
    return np.clip(single, -_LARGEST, _LARGEST)

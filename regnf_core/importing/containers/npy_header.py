"""The header of a .npy array, by a grammar of our own: numpy evaluates it as Python, and would take pickled objects."""

from __future__ import annotations

import re
from dataclasses import dataclass

from regnf_core.errors import FieldFormatError

_MAGIC = b"\x93NUMPY"
_LENGTH_BYTES = {(1, 0): 2, (2, 0): 4, (3, 0): 4}
_MAX_HEADER = 4096
_HEADER = re.compile(
    rb"\{'descr': '(?P<dtype>[<>|=][a-zA-Z][0-9]{0,4})', 'fortran_order': (?P<fortran>True|False), "
    rb"'shape': \((?P<shape>(?:[0-9]{1,15}, ?)*(?:[0-9]{1,15})?)\),? ?\} *\n?"
)
_OBJECTS = re.compile(rb"'descr': '[<>|=]?O")
_MAX_DIMENSIONS = 8
_ITEM_BYTES = {
    "<f2": 2,
    "<f4": 4,
    "<f8": 8,
    "<i2": 2,
    "<i4": 4,
    "<i8": 8,
    "<u2": 2,
    "<u4": 4,
    "<u8": 8,
    "|i1": 1,
    "|u1": 1,
    "|b1": 1,
}


@dataclass(frozen=True)
class NpyHeader:
    """An array's element type as numpy spells it, its shape and order, and where its numbers begin, bytes."""

    dtype: str
    item_bytes: int
    shape: tuple[int, ...]
    fortran_order: bool
    data_at: int


def read_npy_header(name: str, data: memoryview) -> NpyHeader:
    """The header of the array ``name``, whose file begins with ``data``.

    Raises FieldFormatError: NPY_MALFORMED, NPY_OBJECT_ARRAY (pickled objects) or TENSOR_DTYPE (no plain little-endian
    numbers).
    """
    length_bytes = _LENGTH_BYTES.get((data[6], data[7])) if len(data) >= 12 and data[:6] == _MAGIC else None
    if length_bytes is None:
        raise _malformed(name)
    start = 8 + length_bytes
    length = int.from_bytes(data[8:start], "little")
    if length > _MAX_HEADER or start + length > len(data):
        raise _malformed(name)
    text = bytes(data[start : start + length])
    if _OBJECTS.search(text):
        raise FieldFormatError(f"{name} holds pickled Python objects, not numbers", reason="NPY_OBJECT_ARRAY")
    found = _HEADER.fullmatch(text)
    if found is None:
        raise _malformed(name)
    dtype = found["dtype"].decode()
    if dtype not in _ITEM_BYTES:
        raise FieldFormatError(f"{name} is stored as {dtype}; plain numbers are needed", reason="TENSOR_DTYPE")
    shape = tuple(int(extent) for extent in found["shape"].split(b",") if extent.strip())
    if len(shape) > _MAX_DIMENSIONS:
        raise _malformed(name)
    return NpyHeader(dtype, _ITEM_BYTES[dtype], shape, found["fortran"] == b"True", start + length)


def _malformed(name: str) -> FieldFormatError:
    return FieldFormatError(f"{name} has no header of a plain array", reason="NPY_MALFORMED")

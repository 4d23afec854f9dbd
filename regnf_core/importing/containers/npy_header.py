"""The header of a .npy array, read by numpy. Nothing behind the header is read, so no pickle is ever opened.

numpy parses the header as a Python literal, never as code. What it accepts is checked again: plain numbers only.
"""

from __future__ import annotations

import io
import tokenize
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.lib import format as npy

from regnf_core.errors import FieldFormatError

_MAX_HEADER = 4096
_MAX_DIMENSIONS = 8
_MAX_EXTENT = 10**15
_READERS = {
    (1, 0): npy.read_array_header_1_0,
    (2, 0): npy.read_array_header_2_0,
    (3, 0): npy.read_array_header_2_0,  # differs in the encoding of the names of fields, which plain numbers lack
}
_PLAIN_TYPES = frozenset(["<f2", "<f4", "<f8", "<i2", "<i4", "<i8", "<u2", "<u4", "<u8", "|i1", "|u1", "|b1"])
_PARSER_ERRORS = (
    ArithmeticError,
    LookupError,
    MemoryError,
    RecursionError,
    SyntaxError,
    tokenize.TokenError,
    TypeError,
    ValueError,
)
"""What numpy and Python's parser of literals raise for headers that are malformed."""


@dataclass(frozen=True)
class NpyHeader:
    """An array's element type and shape, and where its numbers begin, bytes."""

    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    fortran_order: bool
    data_at: int


def read_npy_header(name: str, data: memoryview) -> NpyHeader:
    """The header of the array ``name``, whose file begins with ``data``.

    Raises FieldFormatError: NPY_MALFORMED, NPY_OBJECT_ARRAY (pickled objects) or TENSOR_DTYPE (no plain little-endian
    numbers).
    """
    file = io.BytesIO(data[: npy.MAGIC_LEN + 4 + _MAX_HEADER])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # headers that Python 2 wrote
            read = _READERS[npy.read_magic(file)]
            shape, fortran_order, dtype = read(file, max_header_size=_MAX_HEADER)
    except _PARSER_ERRORS as error:
        raise _malformed(name) from error
    if dtype.hasobject:
        raise FieldFormatError(f"{name} holds pickled Python objects, not numbers", reason="NPY_OBJECT_ARRAY")
    if dtype.names is not None or len(shape) > _MAX_DIMENSIONS or not all(_is_extent(extent) for extent in shape):
        raise _malformed(name)
    if dtype.str not in _PLAIN_TYPES:
        raise FieldFormatError(f"{name} is stored as {dtype.str}; plain numbers are needed", reason="TENSOR_DTYPE")
    return NpyHeader(dtype, shape, fortran_order, file.tell())


def _is_extent(value: object) -> bool:
    return type(value) is int and 0 <= value < _MAX_EXTENT


def _malformed(name: str) -> FieldFormatError:
    return FieldFormatError(f"{name} has no valid header of an array of numbers", reason="NPY_MALFORMED")

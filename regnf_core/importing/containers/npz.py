"""Arrays of a .npz file: a zip of .npy arrays, each read only when it is requested.

The zip is checked as strictly as torch's, but for deflate, which ``numpy.savez_compressed`` uses. An entry is inflated
to exactly the size that the directory claims for it, and the claims of the requested arrays are added up before that.
"""

from __future__ import annotations

import io
import math
import tokenize
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, finite_float32, require_possible, tensor_error
from regnf_core.importing.containers.zip_members import DEFLATED, STORED, Member, malformed, read_members

# The header of a .npy array, read by numpy. Nothing behind the header is read, so no pickle is ever opened.
#
# numpy parses the header as a Python literal, never as code. What it accepts is checked again: plain numbers only.

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
    *(ArithmeticError, LookupError, MemoryError, RecursionError),
    *(SyntaxError, tokenize.TokenError, TypeError, ValueError),
)
"""What numpy and Python's parser of literals raise for headers that are malformed."""


def array_header(name: str, data: memoryview) -> tuple[np.dtype[np.generic], tuple[int, ...], bool, int]:
    """Of the array ``name``: its type, its shape, whether it is in Fortran's order, and where its numbers begin."""
    file = io.BytesIO(data[: npy.MAGIC_LEN + 4 + _MAX_HEADER])
    malformed_header = FieldFormatError(f"{name} has no valid header of an array of numbers", reason="NPY_MALFORMED")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # headers that Python 2 wrote
            read = _READERS[npy.read_magic(file)]
            shape, fortran_order, dtype = read(file, max_header_size=_MAX_HEADER)
    except _PARSER_ERRORS as error:
        raise malformed_header from error
    if dtype.hasobject:
        raise FieldFormatError(f"{name} holds pickled Python objects, not numbers", reason="NPY_OBJECT_ARRAY")
    sound = len(shape) <= _MAX_DIMENSIONS and all(type(n) is int and 0 <= n < _MAX_EXTENT for n in shape)
    if dtype.names is not None or not sound:
        raise malformed_header
    if dtype.str not in _PLAIN_TYPES:
        raise FieldFormatError(f"{name} is stored as {dtype.str}; plain numbers are required", reason="TENSOR_DTYPE")
    return dtype, shape, fortran_order, file.tell()


MAX_UNPACKED_BYTES = 2 << 30
"""All requested arrays together, as they are stored."""
_SUFFIX = ".npy"
_FEW = 64
"""Most numbers that one of the small arrays beside the large ones has."""


class ArraySource:
    """The arrays of one .npz file by name. ``budget`` caps their bytes together, as float32 and as stored.

    members: what ``read_members`` listed, where the file was read already.
    """

    def __init__(self, data: memoryview, budget: int, members: list[Member] | None = None) -> None:
        self._data = data
        self._members: dict[str, Member] = {}
        for member in read_members(data, (STORED, DEFLATED)) if members is None else members:
            if "/" in member.name or not member.name.endswith(_SUFFIX):
                raise malformed(f"{member.name[:80]} is not an array of a .npz file", "ARCHIVE_ENTRY_NAME")
            self._members[member.name.removesuffix(_SUFFIX)] = member
        self._budget = budget
        self._unpacked = MAX_UNPACKED_BYTES

    def __contains__(self, name: str) -> bool:
        return name in self._members

    @property
    def names(self) -> list[str]:
        """All arrays, in the order of the file."""
        return list(self._members)

    def array(self, name: str) -> Float32Array:
        """The real numbers of an array as contiguous float32.

        Raises FieldFormatError: TENSOR_MISSING, NPY_MALFORMED, NPY_OBJECT_ARRAY, TENSOR_DTYPE, TENSOR_SHAPE,
        TENSOR_TOO_LARGE, TENSOR_NOT_FINITE, TENSOR_STORAGE_MISMATCH, ARCHIVE_DEFLATE_MALFORMED or ARCHIVE_CRC_MISMATCH.
        """
        return finite_float32(name, self._read(name, "f", "real numbers"))

    def integers(self, name: str) -> npt.NDArray[np.int64]:
        """The whole numbers of an array. Raises what :meth:`array` raises."""
        values = self._read(name, "iu", "whole numbers")
        if values.dtype == np.uint64:
            raise tensor_error(f"{name} holds uint64; whole numbers are required", "TENSOR_DTYPE")
        return np.ascontiguousarray(values, dtype=np.int64)

    def weights(self, name: str) -> Float32Array:
        """An array's numbers, of either sort, none below zero. Raises what :meth:`array` raises."""
        return np.maximum(finite_float32(name, self._read(name, "iuf", "numbers")), np.float32(0.0))

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        """A few numbers of either sort, in double precision, in their own shape. Raises what :meth:`array` raises."""
        few = np.asarray(self._read(name, "iuf", "numbers", _FEW), dtype=np.float64)
        if not np.isfinite(few).all():
            raise tensor_error(f"{name} holds a number that is not finite", "TENSOR_NOT_FINITE")
        return few

    def _read(self, name: str, kinds: str, needed: str, most: int | None = None) -> npt.NDArray[Any]:
        """The array, of one of numpy's kinds of numbers."""
        member = self._members.get(name)
        if member is None:
            raise tensor_error(f"{name} is missing", "TENSOR_MISSING")
        self._unpacked -= member.size
        if self._unpacked < 0:
            raise tensor_error(f"with {name} the arrays exceed the limit", "TENSOR_TOO_LARGE")
        raw = member.content(self._data)
        dtype, shape, fortran_order, data_at = array_header(name, raw)
        require_possible(name, shape)
        count = math.prod(shape)
        if most is not None and count > most:
            raise tensor_error(f"{name} has {count} numbers, expected a few", "TENSOR_SHAPE")
        self._budget -= 4 * count
        if self._budget < 0:
            raise tensor_error(f"with {name} the arrays exceed the limit", "TENSOR_TOO_LARGE")
        if len(raw) - data_at != count * dtype.itemsize:
            raise tensor_error(f"{name} has another size than its shape {shape}", "TENSOR_STORAGE_MISMATCH")
        if dtype.kind not in kinds:
            raise tensor_error(f"{name} holds {dtype.name}; {needed} are required", "TENSOR_DTYPE")
        flat = np.frombuffer(raw[data_at:], dtype)
        return flat.reshape(shape, order="F" if fortran_order else "C")

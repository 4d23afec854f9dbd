"""Arrays of a .npz file: a zip of .npy arrays, each read only when it is requested.

The zip is checked as strictly as torch's, but for deflate, which ``numpy.savez_compressed`` uses. An entry is inflated
to exactly the size that the directory claims for it, and the claims of the requested arrays are added up before that.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, finite_float32, require_possible, tensor_error
from regnf_core.importing.containers.npy_header import NpyHeader, read_npy_header
from regnf_core.importing.containers.zip_members import DEFLATED, STORED, Member, read_members
from regnf_core.importing.containers.zip_records import malformed

MAX_UNPACKED_BYTES = 2 << 30
"""All requested arrays together, as they are stored."""
_SUFFIX = ".npy"
_FEW = 64
"""Most numbers that one of the small arrays beside the large ones has."""


class ArraySource:
    """The arrays of one .npz file by name. ``budget`` caps their bytes together, as float32 and as stored."""

    def __init__(self, data: memoryview, budget: int) -> None:
        self._data = data
        self._members = _named(read_members(data, (STORED, DEFLATED)))
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
        values = self._read(name)
        if values.dtype.kind != "f":
            raise tensor_error(f"{name} holds {values.dtype.name}; real numbers are needed", "TENSOR_DTYPE")
        return finite_float32(name, values)

    def integers(self, name: str) -> npt.NDArray[np.int64]:
        """The whole numbers of an array. Raises what :meth:`array` raises."""
        values = self._read(name)
        if values.dtype.kind not in "iu" or values.dtype == np.uint64:
            raise tensor_error(f"{name} holds {values.dtype.name}; whole numbers are needed", "TENSOR_DTYPE")
        return np.ascontiguousarray(values, dtype=np.int64)

    def weights(self, name: str) -> Float32Array:
        """An array's numbers, of either sort, none below zero. Raises what :meth:`array` raises."""
        values = self._read(name)
        if values.dtype.kind not in "iuf":
            raise tensor_error(f"{name} holds {values.dtype.name}; numbers are needed", "TENSOR_DTYPE")
        return np.maximum(finite_float32(name, values), np.float32(0.0))

    def numbers(self, name: str) -> npt.NDArray[np.float64]:
        """A few numbers of either sort, in double precision, in their own shape. Raises what :meth:`array` raises."""
        values = self._read(name, _FEW)
        if values.dtype.kind not in "iuf":
            raise tensor_error(f"{name} holds {values.dtype.name}; numbers are needed", "TENSOR_DTYPE")
        few = np.asarray(values, dtype=np.float64)
        if not np.isfinite(few).all():
            raise tensor_error(f"{name} holds a number that is not finite", "TENSOR_NOT_FINITE")
        return few

    def _read(self, name: str, most: int | None = None) -> npt.NDArray[Any]:
        member = self._members.get(name)
        if member is None:
            raise tensor_error(f"{name} is missing", "TENSOR_MISSING")
        self._unpacked -= member.size
        if self._unpacked < 0:
            raise tensor_error(f"with {name} the arrays exceed the limit", "TENSOR_TOO_LARGE")
        raw = _unpack(name, self._data[member.offset : member.offset + member.packed_size], member)
        header = read_npy_header(name, raw)
        require_possible(name, header.shape)
        count = math.prod(header.shape)
        if most is not None and count > most:
            raise tensor_error(f"{name} has {count} numbers, expected a few", "TENSOR_SHAPE")
        self._budget -= 4 * count
        if self._budget < 0:
            raise tensor_error(f"with {name} the arrays exceed the limit", "TENSOR_TOO_LARGE")
        if len(raw) - header.data_at != count * header.dtype.itemsize:
            raise tensor_error(f"{name} has another size than its shape {header.shape}", "TENSOR_STORAGE_MISMATCH")
        return _array(raw, header)


def _named(members: list[Member]) -> Mapping[str, Member]:
    named = {}
    for member in members:
        if "/" in member.name or not member.name.endswith(_SUFFIX):
            raise malformed(f"{member.name[:80]} is not an array of a .npz file", "ARCHIVE_ENTRY_NAME")
        named[member.name.removesuffix(_SUFFIX)] = member
    return named


def _unpack(name: str, packed: memoryview, member: Member) -> memoryview:
    """The entry's content. Never more than one byte beyond the claimed size is made."""
    content = packed
    if member.method == DEFLATED:
        inflater = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            content = memoryview(inflater.decompress(packed, member.size + 1))
        except zlib.error as error:
            raise _faulty_deflate(name) from error
        if len(content) != member.size or not inflater.eof or inflater.unused_data:
            raise _faulty_deflate(name)
    if zlib.crc32(content) != member.crc32:
        raise FieldFormatError(f"the bytes of {name} are damaged (CRC)", reason="ARCHIVE_CRC_MISMATCH")
    return content


def _faulty_deflate(name: str) -> FieldFormatError:
    return malformed(f"{name} does not inflate to what the archive claims", "ARCHIVE_DEFLATE_MALFORMED")


def _array(raw: memoryview, header: NpyHeader) -> npt.NDArray[Any]:
    flat = np.frombuffer(raw[header.data_at :], dtype=header.dtype)
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C")

"""Tensors that a family needs, as float32 arrays: read from the file only after every claim about them was checked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import Float32Array, finite_float32, require_possible, tensor_error
from regnf_core.importing.containers.legacy_container import TorchArchive
from regnf_core.importing.pickle.pickle_machine import GlobalRef, Placeholder, StorageRef, TensorRef

_STORED: dict[str, np.dtype[Any]] = {
    "float32": np.dtype("<f4"),
    "float64": np.dtype("<f8"),
    "float16": np.dtype("<f2"),
    "bfloat16": np.dtype("<u2"),
}
_STORED_WHOLE: dict[str, np.dtype[Any]] = {"int64": np.dtype("<i8"), "int32": np.dtype("<i4")}
_DEVICE = re.compile(r"(cpu|cuda|mps|xpu|hpu|npu|xla)(:\d{1,3})?")
_ALIGNMENT = 16


class TensorSource:
    """Materializes tensors of one archive. Float32 tensors are views of the map where they lie aligned, as torch writes
    them; nothing else of the file is touched.

    ``budget`` caps the bytes of all tensors together, as float32.
    """

    def __init__(self, archive: TorchArchive, budget: int) -> None:
        self._archive = archive
        self._budget = budget

    @property
    def left(self) -> int:
        """Bytes of the budget."""
        return self._budget

    def array(self, name: str, value: object) -> Float32Array:
        """The tensor called ``name`` as a contiguous float32 array of its own shape.

        Raises FieldFormatError: UNSAFE_GLOBAL_IN_WEIGHTS, TENSOR_EXPECTED, TENSOR_NOT_DENSE, TENSOR_SHAPE,
        TENSOR_DTYPE, TENSOR_DEVICE, TENSOR_STORAGE_MISSING, TENSOR_STORAGE_MISMATCH, TENSOR_TOO_LARGE,
        TENSOR_NOT_FINITE or ARCHIVE_CRC_MISMATCH.
        """
        ref = as_tensor(name, value)
        values = self._values(name, ref, _stored_type(name, ref, _STORED, "real"))
        if ref.storage.dtype == "bfloat16":
            values = (np.ascontiguousarray(values).astype(np.uint32) << np.uint32(16)).view(np.float32)
        return finite_float32(name, values)

    def integers(self, name: str, value: object) -> npt.NDArray[np.int64]:
        """The tensor called ``name``, of whole numbers, as a contiguous array. Raises what :meth:`array` raises."""
        ref = as_tensor(name, value)
        return np.ascontiguousarray(self._values(name, ref, _stored_type(name, ref, _STORED_WHOLE, "whole")), np.int64)

    def _values(self, name: str, ref: TensorRef, stored: np.dtype[Any]) -> npt.NDArray[Any]:
        count = math.prod(ref.shape)
        self._budget -= 4 * count
        if self._budget < 0:
            raise tensor_error(f"with {name} the tensors exceed the limit", "TENSOR_TOO_LARGE")
        raw = self._storage(name, ref.storage, stored, count)
        _check_dense(name, ref, count)
        flat = np.frombuffer(raw, dtype=stored)
        if flat.ctypes.data % _ALIGNMENT:  # torch crashes over the odd addresses that other writers' entries have
            flat = flat.copy()
        order = sorted(range(len(ref.shape)), key=lambda axis: (-ref.strides[axis], ref.shape[axis] == 1))
        in_file = flat.reshape([ref.shape[axis] for axis in order])
        return in_file.transpose(np.argsort(order)) if order else in_file

    def _storage(self, name: str, storage: StorageRef, stored: np.dtype[Any], count: int) -> memoryview:
        entry = self._archive.entries.get(f"data/{storage.key}")
        if entry is None:
            raise tensor_error(f"the storage of {name} is not in the archive", "TENSOR_STORAGE_MISSING")
        if storage.count != count or entry.size != count * stored.itemsize:
            message = f"{name} has {count} elements, its storage {storage.count} in {entry.size} bytes"
            raise tensor_error(message, "TENSOR_STORAGE_MISMATCH")
        return self._archive.read(f"data/{storage.key}")


def as_tensor(name: str, value: object) -> TensorRef:
    """``value`` if it is a tensor; otherwise a refusal that says what stands in its place."""
    if isinstance(value, TensorRef):
        return value
    if isinstance(value, (Placeholder, GlobalRef)):
        message = f"{name} would need to run {value.full_name}, which is not allowed"
        raise tensor_error(message, "UNSAFE_GLOBAL_IN_WEIGHTS")
    raise tensor_error(f"{name} is a {type(value).__name__}, not a tensor", "TENSOR_EXPECTED")


def lookup(values: Mapping[Any, Any], name: str) -> object:
    """The value under ``name``. Raises FieldFormatError (TENSOR_MISSING)."""
    if name not in values:
        raise tensor_error(f"{name} is missing", "TENSOR_MISSING")
    return values[name]


def _stored_type(name: str, ref: TensorRef, types: Mapping[str, np.dtype[Any]], sort: str) -> np.dtype[Any]:
    storage = ref.storage
    stored = types.get(storage.dtype or "")
    if stored is None:
        raise tensor_error(f"{name} is stored as {storage.type_name}; {sort} numbers are required", "TENSOR_DTYPE")
    if not _DEVICE.fullmatch(storage.device):
        raise tensor_error(f"{name} has no data (device {storage.device!r})", "TENSOR_DEVICE")
    if not ref.plain:
        raise tensor_error(f"{name} extends beyond its storage", "TENSOR_NOT_DENSE")
    return stored


def _check_dense(name: str, ref: TensorRef, count: int) -> None:
    """Every element of the storage occurs exactly once: strides are those of some order of the axes, offset is 0."""
    require_possible(name, ref.shape)
    expected = 1
    for stride, extent in sorted((s, n) for s, n in zip(ref.strides, ref.shape, strict=True) if n != 1):
        if stride != expected and count:
            raise tensor_error(f"{name} is not dense: strides {ref.strides} of shape {ref.shape}", "TENSOR_NOT_DENSE")
        expected *= extent
    if ref.offset:
        raise tensor_error(f"{name} begins at element {ref.offset} of its storage", "TENSOR_STORAGE_MISMATCH")

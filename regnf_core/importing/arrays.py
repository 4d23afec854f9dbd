"""Plain arrays of an upload: their types, and the checks of shape and of finite numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from regnf_core.errors import FieldFormatError

Float32Array = npt.NDArray[np.float32]
StoredArray = npt.NDArray[np.float32] | npt.NDArray[np.float16] | npt.NDArray[np.int32]
"""What a regnf field file holds."""

_FINITE_CHUNK = 1 << 20
_MAX_ELEMENTS = 1 << 60
"""What numpy can address at eight bytes each. It counts empty axes as ones: even an array of nothing has a limit."""


def tensor_error(message: str, reason: str) -> FieldFormatError:
    return FieldFormatError(message, reason=reason)


def require_shape(name: str, array: Float32Array, shape: tuple[int | None, ...]) -> None:
    """Raise FieldFormatError (TENSOR_SHAPE) unless the shapes agree; None stands for any extent above zero."""
    fits = array.ndim == len(shape) and all(
        have == want or (want is None and have > 0) for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if extent is None else str(extent) for extent in shape)
        raise tensor_error(f"{name} has shape {array.shape}, expected ({wanted})", "TENSOR_SHAPE")


def finite_float32(name: str, values: npt.NDArray[Any]) -> Float32Array:
    """The array ``name`` as contiguous float32 in its own shape. Raises FieldFormatError (TENSOR_NOT_FINITE)."""
    with np.errstate(over="ignore"):  # a number too large for float32 becomes inf, which the check refuses
        array = np.ascontiguousarray(values, dtype=np.float32).reshape(values.shape)
    flat = array.reshape(-1)
    for start in range(0, flat.size, _FINITE_CHUNK):
        if not np.isfinite(flat[start : start + _FINITE_CHUNK]).all():
            raise tensor_error(f"{name} holds a number that is not finite", "TENSOR_NOT_FINITE")
    return array


def require_possible(name: str, shape: tuple[int, ...]) -> None:
    """Raise FieldFormatError (TENSOR_SHAPE) for a shape that no array has, even one of nothing."""
    if math.prod(max(extent, 1) for extent in shape) > _MAX_ELEMENTS:
        raise tensor_error(f"{name} has an impossible shape: {shape}", "TENSOR_SHAPE")

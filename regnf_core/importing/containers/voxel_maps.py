"""What maps of voxel blocks share, whatever wrote them: unobserved voxels, the bounds, the truncation."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import Float32Array, tensor_error

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

USUAL_TRUNCATION = 8.0
_TRUNCATIONS = (USUAL_TRUNCATION, 4.0, 5.0, 6.0, 10.0, 3.0, 2.0, 12.0, 16.0, 20.0)
"""Voxels, the most usual first."""
_FAR_APART = 1e6
_VOXELS_AT_ONCE = 1 << 21
_MIDDLE = 0.5
"""Of a truncated distance's range: within it slopes are neither cut off nor averaged with what is cut off."""
_MIN_SLOPES = 100


def fill_unseen(values: Float32Array, seen: BoolArray, voxel_size: float, outward: int = 1) -> None:
    """Give voxels that were never seen the value of the nearest seen one of their block, plus the distance to it.

    So what was never seen is free space beyond what was seen. values, seen: (B, R, R, R), at least one voxel seen in
    each block; ``values`` is changed in place. outward: -1 where values are negative in free space.
    """
    from scipy import ndimage  # takes a moment to load, which most files need not wait for

    partial = np.flatnonzero(~seen.all(axis=(1, 2, 3)))
    at_once = max(1, _VOXELS_AT_ONCE // seen[0].size)
    for start in range(0, partial.size, at_once):
        chosen = partial[start : start + at_once]
        # One transform for many blocks: along the first axis they are so far apart that none sees into another.
        distance, nearest = ndimage.distance_transform_edt(
            ~seen[chosen], sampling=(_FAR_APART, 1.0, 1.0, 1.0), return_indices=True
        )
        values[chosen] = values[chosen][tuple(nearest)] + np.float32(outward * voxel_size) * distance.astype(np.float32)


def seen_extent(blocks: IntArray, seen: BoolArray) -> tuple[IntArray, IntArray]:
    """The lowest and the highest node (3,) that was seen; node R b + i is voxel i of block b."""
    edge = seen.shape[1]
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for axis, others in enumerate(((2, 3), (1, 3), (1, 2))):
        along: BoolArray = np.any(seen, axis=others)  # (B, R)
        first, last = along.argmax(axis=1), edge - 1 - along[:, ::-1].argmax(axis=1)
        low[axis] = (edge * blocks[:, axis] + first).min()
        high[axis] = (edge * blocks[:, axis] + last).max()
    return low, high


def tell_truncation(values: Float32Array, seen: BoolArray) -> tuple[float, float | None]:
    """The truncation distance in voxels, of values (B, R, R, R) cut off at 1, and the slope's median under it.

    A distance's slope is 1, so the slopes of the values near the surface tell. The slope is None, and the truncation
    the most usual one, where too little surface lies within the blocks.
    """
    slopes = _slopes(values, seen)
    if slopes.size < _MIN_SLOPES:
        return USUAL_TRUNCATION, None
    median = float(np.median(slopes))
    best = min(_TRUNCATIONS, key=lambda voxels: abs(math.log(max(voxels * median, 1e-9))))
    return best, best * median


def require_shape_of_blocks(name: str, values: npt.NDArray[np.generic], blocks: int, edge: int) -> None:
    """Raise FieldFormatError (TENSOR_SHAPE) unless ``values`` has ``blocks`` blocks of ``edge``^3 voxels."""
    if values.shape != (blocks, edge, edge, edge):
        raise tensor_error(f"{name} has shape {values.shape}, expected {blocks} blocks of {edge}^3", "TENSOR_SHAPE")


def _slopes(values: Float32Array, seen: BoolArray) -> Float32Array:
    """The gradients' norms per voxel where a voxel and its three upper neighbors are well within the range."""
    usable = seen & (np.abs(values) < _MIDDLE)
    here = (slice(None), slice(0, -1), slice(0, -1), slice(0, -1))
    squared = np.zeros_like(values[here])
    kept = usable[here].copy()
    for axis in (1, 2, 3):
        upper = list(here)
        upper[axis] = slice(1, None)
        squared += (values[tuple(upper)] - values[here]) ** 2
        kept &= usable[tuple(upper)]
    return np.sqrt(squared[kept])

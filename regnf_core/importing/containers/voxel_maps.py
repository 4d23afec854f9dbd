"""What maps of voxel blocks share, whatever wrote them: unobserved voxels, the bounds, the weights."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import Float32Array, tensor_error
from regnf_core.schema.similarity import local_origin

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_FAR_APART = 1e6
_VOXELS_AT_ONCE = 1 << 21
_LARGEST_WEIGHT = 60_000.0
"""float16 holds no number much beyond."""


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


def filled_nodes(values: Float32Array, seen: BoolArray, spacing: npt.NDArray[np.float64], outward: int) -> Float32Array:
    """The same of one grid (X, Y, Z), as a new array; its nodes are ``spacing`` (3,) apart."""
    from scipy import ndimage

    distance, nearest = ndimage.distance_transform_edt(~seen, sampling=tuple(spacing), return_indices=True)
    filled: Float32Array = values[tuple(nearest)] + np.float32(outward) * distance.astype(np.float32)
    return filled


def near_blocks(blocks: IntArray, length: float) -> tuple[IntArray, list[float] | None]:
    """Blocks (B, 3) of edge ``length`` with whole numbers subtracted where they lie far from the origin, and the place
    that was subtracted; None: nothing."""
    low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
    origin = local_origin([(length * corner).tolist() for corner in (low, high)])
    if origin is None:
        return blocks, None
    steps = np.round(np.array(origin) / length).astype(np.int64)
    return blocks - steps, (length * steps).tolist()


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


def require_shape_of_blocks(name: str, values: npt.NDArray[np.generic], blocks: int, edge: int) -> None:
    """Raise FieldFormatError (TENSOR_SHAPE) unless ``values`` has ``blocks`` blocks of ``edge``^3 voxels."""
    if values.shape != (blocks, edge, edge, edge):
        raise tensor_error(f"{name} has shape {values.shape}, expected {blocks} blocks of {edge}^3", "TENSOR_SHAPE")


def stored_weights(weights: Float32Array) -> npt.NDArray[np.float16]:
    """How much was seen of each voxel, as a field file keeps it: 0 where nothing was."""
    return np.clip(weights, 0.0, _LARGEST_WEIGHT).astype(np.float16)

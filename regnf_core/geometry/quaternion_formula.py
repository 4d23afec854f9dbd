"""The rotation matrix of a quaternion. Torch-free: for plain numbers and for tensors alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

Number = TypeVar("Number", float, "Tensor")
Row = tuple[Number, Number, Number]


def rotation_rows(x: Number, y: Number, z: Number, w: Number) -> tuple[Row[Number], Row[Number], Row[Number]]:
    """The three rows of the rotation matrix of the unit quaternion x, y, z (vector part), w (real part).

    The numbers may be tensors of one shape; each entry then is such a tensor.
    """
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )

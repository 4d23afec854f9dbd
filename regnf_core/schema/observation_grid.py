"""How a field's observation is stored: the grid's place, and its voxels' states in one tensor, sixteen to a number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge, Gt, Le

from regnf_core.schema.tensor_check import INTEGER_TYPES, TensorSpec, require, require_shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

OBSERVATION = "observation"
"""The tensor's name, and the description's entry."""
UNSEEN, FREE, SURFACE = 0, 1, 2
"""A voxel's states: unobserved; seen to be free; a surface was measured in it."""
_BITS, _PER_WORD = 2, 16
MAX_COUNT = 512
"""Voxels along an axis, at most."""
FARTHEST = 1e6
"""The largest coordinate."""
_Coordinate = Annotated[float, Ge(-FARTHEST), Le(FARTHEST)]  # which no NaN is
_Count = Annotated[int, Ge(1), Le(MAX_COUNT)]


@dataclass(frozen=True)
class ObservationGrid:
    """A grid of cubic voxels, in the coordinates of the kind's function."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    low: tuple[_Coordinate, _Coordinate, _Coordinate]
    """The lowest corner."""
    voxel: Annotated[float, Gt(0), Le(1e6)]
    """A voxel's edge."""
    counts: tuple[_Count, _Count, _Count]

    @property
    def voxels(self) -> int:
        """How many there are."""
        return self.counts[0] * self.counts[1] * self.counts[2]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH) unless the states are stored as this grid asks."""
        require(OBSERVATION in tensors, f"the description has an {OBSERVATION}, but there is no such tensor")
        require(tensors[OBSERVATION].dtype in INTEGER_TYPES, f"{OBSERVATION} is not stored as whole numbers")
        require_shape(tensors, OBSERVATION, (-(-self.voxels // _PER_WORD),))

    def pack(self, states: NDArray[np.uint8]) -> NDArray[np.int32]:
        """States (X, Y, Z) as stored: two bits each, z fastest, sixteen to a number from its lowest bits up."""
        flat = np.zeros(-(-self.voxels // _PER_WORD) * _PER_WORD, np.uint32)
        flat[: self.voxels] = states.ravel()
        words = flat.reshape(-1, _PER_WORD) << (_BITS * np.arange(_PER_WORD, dtype=np.uint32))
        packed: NDArray[np.int32] = np.bitwise_or.reduce(words, axis=1).astype("<u4").view("<i4")
        return packed

    def unpack(self, words: NDArray[np.int32]) -> NDArray[np.uint8]:
        """States (X, Y, Z) from what :meth:`pack` made. The fourth state that two bits have is read as SURFACE."""
        octets = np.ascontiguousarray(words, "<i4").view(np.uint8)  # four voxels each: no copy wider than the states
        states: NDArray[np.uint8] = (octets[:, None] >> np.arange(0, 8, _BITS, dtype=np.uint8)) & np.uint8(3)
        grid: NDArray[np.uint8] = np.minimum(states.ravel()[: self.voxels], np.uint8(SURFACE)).reshape(self.counts)
        return grid

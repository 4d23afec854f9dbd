"""What every kind of field shares: the entries of its description, and the check of its tensors. Plain data."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import AfterValidator, Field, FiniteFloat

from regnf_core.schema.closed import Closed
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.similarity import require_similarity
from regnf_core.schema.tensor_check import (
    INTEGER_TYPES,
    TensorSpec,
    check_layers,
    count_layers,
    count_rows,
    layer_tensor_names,
    require,
    require_names,
    require_shape,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


# How a field's color is stored: a small network that follows the geometry's, or colors at vertices and nodes.

COLOR = "color"
"""The description's entry; the tensors' names begin with it and a dot."""
VALUES = "values"
"""The tensor of colors at vertices and nodes, without the beginning."""
TABLE = "hash_table"
"""The tensor of the color's own grid, without the beginning."""
_PREFIX = f"{COLOR}."
T = TypeVar("T")


@dataclass(frozen=True)
class DirectionEncoding(Closed):
    """Of the line of sight. frequency: the direction d, then sines and cosines of 2^k d (times 2 pi), k < degree, each
    axis by axis. spherical_harmonics: all real ones of orders below ``degree``, as tiny-cuda-nn sorts them."""

    encoding: Literal["frequency", "spherical_harmonics"]
    degree: Annotated[int, Ge(0), Le(24)]
    two_pi: bool = False

    @property
    def width(self) -> int:
        """Columns of the network's input."""
        return 3 + 6 * self.degree if self.encoding == "frequency" else self.degree**2


@dataclass(frozen=True)
class NetworkColor(Closed):
    """A network after the geometry's; see :class:`regnf_core.fields.color_head.ColorHead`.

    Its input: position, encoded direction, gradient, a hash grid's features, what the geometry's last layer is given.
    """

    form: Literal["network"]
    position: bool = True
    """Whether the input has the position, contracted where the geometry's is."""
    direction: DirectionEncoding | None = None
    """None: the color is the same from everywhere."""
    gradient: Literal["raw", "unit"] | None = "raw"
    """Of the function by the position. unit: divided by its length."""
    hash: HashGridConfig | None = None
    """A grid of its own; None: there is none."""
    grid_radius: Annotated[float, Gt(0), Le(1e6)] = 2.0
    """It covers [-grid_radius, grid_radius]^3."""
    output: Literal["sigmoid", "linear"] = "sigmoid"
    padding: Annotated[float, Ge(0), Le(1)] = 0.0
    """The result is multiplied by 1 + 2 padding, less the padding."""

    @property
    def own_width(self) -> int:
        """Columns of the input before those of the geometry."""
        encodings = sum(encoding.width for encoding in (self.direction, self.hash) if encoding is not None)
        return 3 * self.position + encodings + (0 if self.gradient is None else 3)

    def check(self, tensors: Mapping[str, TensorSpec], hidden_width: int) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH).

        tensors: names without their beginning · hidden_width: columns of the geometry's last layer.
        """
        layers = count_layers(tensors)
        require_names(tensors, layer_tensor_names(layers) | ({TABLE} if self.hash is not None else set()))
        if self.hash is not None:
            require_shape(tensors, TABLE, (self.hash.entries, self.hash.features_per_level))
        check_layers(tensors, self.own_width + hidden_width)
        rows = count_rows(tensors, f"layers.{layers - 1}.weight")
        require(rows == 3, f"the color network has {rows} outputs, expected 3")
        if self.direction is not None and self.direction.encoding == "spherical_harmonics":
            require(1 <= self.direction.degree <= 4, "spherical harmonics must have degree 1 to 4")


@dataclass(frozen=True)
class ValueColor(Closed):
    """Colors where the kind has its numbers: at a mesh's vertices, at the nodes of a grid or of blocks of voxels."""

    form: Literal["values"]

    def check(self, tensors: Mapping[str, TensorSpec], shape: tuple[int, ...]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH). shape: of the vertices or nodes."""
        require_names(tensors, {VALUES})
        require_shape(tensors, VALUES, (*shape, 3))


ColorDescription = Annotated[NetworkColor | ValueColor, Field(discriminator="form")]


def split_color(tensors: Mapping[str, T]) -> tuple[dict[str, T], dict[str, T]]:
    """The geometry's tensors, and the color's with names without their beginning."""
    own = {name: value for name, value in tensors.items() if not name.startswith(_PREFIX)}
    color = {name.removeprefix(_PREFIX): value for name, value in tensors.items() if name.startswith(_PREFIX)}
    return own, color


def color_tensors(tensors: Mapping[str, T]) -> dict[str, T]:
    """The color's tensors by the names that they have in the file."""
    return {_PREFIX + name: value for name, value in tensors.items()}


# How a field's observation is stored: the grid's place, and its voxels' states in one tensor, sixteen to a number.

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
class ObservationGrid(Closed):
    """A grid of cubic voxels, in the coordinates of the kind's function."""

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


Corner = tuple[float, float, float]
_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Rows = tuple[_Row, _Row, _Row, _Row]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def _similarity(rows: Rows) -> Rows:
    require_similarity(rows)
    return rows


@dataclass(frozen=True)
class Placement(Closed):
    """How a field lies in its dataset's frame, where it is requested in that."""

    transform: Annotated[Rows, AfterValidator(_similarity)]
    """4 x 4 matrix of a similarity, row by row: takes points of the function's frame, after ``world_scale``, to
    the dataset's."""
    bounds: tuple[Corner, Corner]
    """Lowest and highest corner of the region where the field has meaning, before the transform."""


@dataclass(frozen=True, kw_only=True)
class FieldDescription(Closed, ABC):
    """Which function a file's tensors parametrize. A kind adds entries of its own and ``check_tensors``.

    A kind's function f works in its own coordinates; the field is S(x) = sign * world_scale * f(x / world_scale), and
    with a placement of the scale s the field is s S(T^-1 x).
    """

    kind: str
    """One of the names in ``regnf_core.schema.kinds.KINDS``."""
    bounds: tuple[Corner, Corner]
    """Lowest and highest corner of the region where the field has meaning, the field's own frame and unit."""
    world_scale: Annotated[float, Ge(1e-6), Le(1e6)] = 1.0
    """Length, in the field's unit, of one unit of the function's coordinates."""
    sign: Literal[1, -1] = 1
    """-1: the function is negative in free space."""
    up_axis: Axis | None = None
    """Which axis points up, where it is known. Changes nothing about the function."""
    label: Annotated[str, MaxLen(200)] | None = None
    source: dict[str, Any] = field(default_factory=dict)
    """Free notes on the field's origin."""
    placement: Placement | None = None
    """Set: the field is in its dataset's frame, and so are ``bounds``."""
    observation: ObservationGrid | None = None
    """What was seen of the volume, if it is known; its states are one more tensor."""
    inverse_deviation: Annotated[float, Gt(0), Le(1e12)] | None = None
    """NeuS's s, which says how opaque the function's values are, per unit of its coordinates, if it is known."""
    color: ColorDescription | None = None
    """Its tensors have names of their own."""

    @property
    def function_bounds(self) -> tuple[Corner, Corner]:
        """The bounds in the function's coordinates."""
        (ax, ay, az), (bx, by, bz) = self.bounds if self.placement is None else self.placement.bounds
        s = self.world_scale
        return (ax / s, ay / s, az / s), (bx / s, by / s, bz / s)

    def check(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first of all tensors that is not as described."""
        if self.observation is not None:
            self.observation.check_tensors(tensors)
            tensors = {name: spec for name, spec in tensors.items() if name != OBSERVATION}
        own, color = (tensors, {}) if self.color is None else split_color(tensors)
        self.check_tensors(own)
        if isinstance(self.color, NetworkColor):
            width = self.hidden_width(own)
            require(width is not None, f"fields of the kind {self.kind} have no color by a network")
            self.color.check(color, width or 0)
        elif self.color is not None:
            shape = self.node_shape(own)
            require(shape is not None, f"fields of the kind {self.kind} have no color by values")
            self.color.check(color, shape or ())

    def hidden_width(self, tensors: Mapping[str, TensorSpec]) -> int | None:
        """Columns of the last layer, which a color's network sees too; None: the kind has no such network."""
        del tensors
        return None

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...] | None:
        """The shape of the vertices or nodes that may have colors; None: the kind has none."""
        del tensors
        return None

    @abstractmethod
    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first of the function's tensors that is amiss."""

"""What every kind of field shares: the entries of its description, and the check of its tensors. Plain data."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import AfterValidator, FiniteFloat

from regnf_core.schema.color import ColorDescription, NetworkColor, ValueColor, split_color
from regnf_core.schema.observation_grid import OBSERVATION, ObservationGrid
from regnf_core.schema.similarity import require_similarity
from regnf_core.schema.tensor_check import TensorSpec, require

FORBID_UNKNOWN: dict[str, Any] = {"extra": "forbid"}
Corner = tuple[float, float, float]
_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Rows = tuple[_Row, _Row, _Row, _Row]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def _similarity(rows: Rows) -> Rows:
    require_similarity(rows)
    return rows


@dataclass(frozen=True)
class Placement:
    """How a field lies in its dataset's frame, where it is asked for in that."""

    __pydantic_config__: ClassVar[dict[str, Any]] = FORBID_UNKNOWN

    transform: Annotated[Rows, AfterValidator(_similarity)]
    """4 x 4 matrix of a similarity, row by row: takes points of the function's frame, after ``world_scale``, to
    the dataset's."""
    bounds: tuple[Corner, Corner]
    """Lowest and highest corner of the region where the field has meaning, before the transform."""


@dataclass(frozen=True, kw_only=True)
class FieldDescription(ABC):
    """Which function a file's tensors parametrize. A kind adds entries of its own and ``check_tensors``.

    A kind's function f works in its own coordinates; the field is S(x) = sign * world_scale * f(x / world_scale), and
    with a placement of the scale s the field is s S(T^-1 x).
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = FORBID_UNKNOWN

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
        if self.color is None:
            self.check_tensors(tensors)
            return
        own, color = split_color(tensors)
        self.check_tensors(own)
        self._check_color(self.color, color, own)

    def hidden_width(self, tensors: Mapping[str, TensorSpec]) -> int | None:
        """Columns of the last layer, which a color's network sees too; None: the kind has no such network."""
        del tensors
        return None

    def node_shape(self, tensors: Mapping[str, TensorSpec]) -> tuple[int, ...] | None:
        """The shape of the vertices or nodes that may have colors; None: the kind has none."""
        del tensors
        return None

    def _check_color(
        self,
        color: NetworkColor | ValueColor,
        tensors: Mapping[str, TensorSpec],
        own: Mapping[str, TensorSpec],
    ) -> None:
        if isinstance(color, NetworkColor):
            width = self.hidden_width(own)
            require(width is not None, f"fields of the kind {self.kind} have no color by a network")
            color.check(tensors, width or 0)
        else:
            shape = self.node_shape(own)
            require(shape is not None, f"fields of the kind {self.kind} have no color by values")
            color.check(tensors, shape or ())

    @abstractmethod
    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first of the function's tensors that is amiss."""

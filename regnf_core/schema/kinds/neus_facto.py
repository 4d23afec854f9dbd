"""The kind ``neus_facto``: hash grid, sines and cosines and the position itself into a small softplus network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.kinds.kind import FORBID_UNKNOWN, FieldDescription
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_names, require_shape

if TYPE_CHECKING:
    from torch import Tensor

    from regnf_core.fields.neus_facto import NeusFactoField

Contraction = Literal["none", "linf", "linf_grid"]

SKIP_LAYER = 4
"""A network with more layers than this sees its input again at this one."""
MAX_LAYERS = 32


@dataclass(frozen=True)
class PositionalEncodingDescription:
    """Sines and cosines of the position; see :class:`regnf_core.fields.positional_encoding.PositionalEncoding`."""

    __pydantic_config__: ClassVar[dict[str, Any]] = FORBID_UNKNOWN

    degree: Annotated[int, Ge(0), Le(24)] = 6
    two_pi: bool = False
    used: bool = True
    """False: the network has the columns, but they were always fed zeros."""
    base_frequency: Annotated[float, Ge(1e-6), Le(1e6)] = 1.0
    """A factor of all frequencies."""
    off_axis: bool = False
    """True: of the lengths along 21 directions, those of an icosahedron, in place of the three coordinates."""

    @property
    def width(self) -> int:
        """Columns of the network's input."""
        return 2 * self.degree * (21 if self.off_axis else 3)


@dataclass(frozen=True, kw_only=True)
class NeusFactoDescription(FieldDescription):
    """A field of the neus-facto kind; see :class:`regnf_core.fields.neus_facto.NeusFactoFunction`."""

    family: Literal["neus_facto"]
    hash: HashGridConfig | None = None
    """None: the network has no columns for a grid."""
    positional_encoding: PositionalEncodingDescription | None = None
    """None: the network has no columns for sines and cosines."""
    use_grid: bool = True
    """False: the network has the grid's columns, but they were always fed zeros; no table is stored."""
    contraction: Contraction = "none"
    grid_radius: Annotated[float, Gt(0), Le(1e6)] = 2.0
    """The grid covers [-grid_radius, grid_radius]^3."""
    level_mask: Annotated[int, Ge(1), Le(32)] | None = None
    """Levels in use, coarsest first; the features of finer ones are zero. None: all."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines, grid features."""
        encodings = (self.positional_encoding, self.hash)
        return 3 + sum(encoding.width for encoding in encodings if encoding is not None)

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        layers = sum(name.endswith(".weight") for name in tensors)
        require(1 <= layers <= MAX_LAYERS, f"the field has {layers} layers, expected 1 to {MAX_LAYERS}")
        names = {f"layers.{i}.{part}" for i in range(layers) for part in ("weight", "bias")}
        stored_grid = self.hash if self.use_grid else None
        require_names(tensors, names | ({"hash_table"} if stored_grid is not None else set()))
        if stored_grid is not None:
            require_shape(tensors, "hash_table", (stored_grid.entries, stored_grid.features_per_level))
        self._check_layers(tensors, layers)

    def _check_layers(self, tensors: Mapping[str, TensorSpec], layers: int) -> None:
        width = self.input_width
        for layer in range(layers):
            if layer == SKIP_LAYER:
                width += self.input_width
            rows = count_rows(tensors, f"layers.{layer}.weight")
            require_shape(tensors, f"layers.{layer}.weight", (rows, width))
            require_shape(tensors, f"layers.{layer}.bias", (rows,))
            width = rows

    def build(self, tensors: Mapping[str, Tensor]) -> NeusFactoField:
        """The field, with columns left out that only ever saw zeros (an unused encoding, masked levels)."""
        from regnf_core.fields.neus_facto import build_neus_facto

        return build_neus_facto(self, tensors)

"""How a field's color is stored: a small network that follows the geometry's, or colors at vertices and nodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from annotated_types import Ge, Gt, Le
from pydantic import Field

from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.layers import check_layers, count_layers, layer_tensor_names
from regnf_core.schema.tensor_check import TensorSpec, count_rows, require, require_names, require_shape

COLOR = "color"
"""The description's entry; the tensors' names begin with it and a dot."""
VALUES = "values"
"""The tensor of colors at vertices and nodes, without the beginning."""
TABLE = "hash_table"
"""The tensor of the color's own grid, without the beginning."""
_PREFIX = f"{COLOR}."
T = TypeVar("T")


@dataclass(frozen=True)
class DirectionEncoding:
    """Of the line of sight. frequency: the direction d, then sines and cosines of 2^k d (times 2 pi), k < degree, each
    axis by axis. spherical_harmonics: all real ones of orders below ``degree``, as tiny-cuda-nn sorts them."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    encoding: Literal["frequency", "spherical_harmonics"]
    degree: Annotated[int, Ge(0), Le(24)]
    two_pi: bool = False

    @property
    def width(self) -> int:
        """Columns of the network's input."""
        return 3 + 6 * self.degree if self.encoding == "frequency" else self.degree**2


@dataclass(frozen=True)
class NetworkColor:
    """A network after the geometry's; see :class:`regnf_core.fields.color_head.ColorHead`.

    Its input: position, encoded direction, gradient, a hash grid's features, what the geometry's last layer is given.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

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
        require(rows == 3, f"the color's network has {rows} results, expected 3")
        if self.direction is not None and self.direction.encoding == "spherical_harmonics":
            require(1 <= self.direction.degree <= 4, "spherical harmonics are known of degrees 1 to 4")


@dataclass(frozen=True)
class ValueColor:
    """Colors where the kind has its numbers: at a mesh's vertices, at the nodes of a grid or of blocks of voxels."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

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

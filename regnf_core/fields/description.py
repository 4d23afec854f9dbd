"""What a safe field file says about its tensors: which function they parametrise, and which shapes that asks for.

Torch-free: the import gate writes descriptions and the worker's parent reads them without loading torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le, MaxLen
from pydantic import TypeAdapter, ValidationError

from regnf_core.errors import FieldFormatError
from regnf_core.fields.hash_grid_config import HashGridConfig

Contraction = Literal["none", "linf", "linf_grid"]
_FORBID_UNKNOWN: dict[str, Any] = {"extra": "forbid"}
_FLOAT_TYPES = ("F32", "F16")
_Corner = tuple[float, float, float]

SKIP_LAYER = 4
"""A network with more layers than this sees its input again at this one."""
MAX_LAYERS = 32


@dataclass(frozen=True)
class TensorSpec:
    """A stored tensor's shape and its safetensors type name."""

    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class PositionalEncodingDescription:
    """Sines and cosines of the position; see :class:`regnf_core.fields.positional_encoding.PositionalEncoding`."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID_UNKNOWN

    degree: Annotated[int, Ge(0), Le(24)] = 6
    two_pi: bool = False
    used: bool = True
    """False: the network has the columns, but they were always fed zeros."""

    @property
    def width(self) -> int:
        """Columns of the network's input."""
        return 6 * self.degree


@dataclass(frozen=True)
class NeusFactoDescription:
    """A field of the neus-facto kind; see :class:`regnf_core.fields.neus_facto.NeusFactoFunction`."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID_UNKNOWN

    family: Literal["neus_facto"]
    bounds: tuple[_Corner, _Corner]
    """Lowest and highest corner of the region where the field has meaning, own frame."""
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
    label: Annotated[str, MaxLen(200)] | None = None
    source: dict[str, Any] = field(default_factory=dict)
    """Free notes on the field's origin."""

    @property
    def input_width(self) -> int:
        """Columns of the network's first layer: position, sines and cosines, grid features."""
        encodings = (self.positional_encoding, self.hash)
        return 3 + sum(encoding.width for encoding in encodings if encoding is not None)

    @property
    def has_table(self) -> bool:
        """Whether a hash table is stored."""
        return self.hash is not None and self.use_grid

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> int:
        """The number of layers, once every tensor's name, type and shape is what this description asks for.

        Raises FieldFormatError (FIELD_SHAPES_MISMATCH) naming the first fault.
        """
        layers = sum(name.endswith(".weight") for name in tensors)
        names = {f"layers.{i}.{part}" for i in range(layers) for part in ("weight", "bias")}
        if self.has_table:
            names.add("hash_table")
        _require(1 <= layers <= MAX_LAYERS, f"the field has {layers} layers, expected 1 to {MAX_LAYERS}")
        _require(set(tensors) == names, f"unexpected or missing tensors: {sorted(names ^ set(tensors))[:4]}")
        for name, spec in sorted(tensors.items()):
            _require(spec.dtype in _FLOAT_TYPES, f"{name} is {spec.dtype}, expected one of {_FLOAT_TYPES}")
        if self.hash is not None and self.use_grid:
            _check_shape("hash_table", tensors, (self.hash.entries, self.hash.features_per_level))
        self._check_layers(tensors, layers)
        return layers

    def _check_layers(self, tensors: Mapping[str, TensorSpec], layers: int) -> None:
        width = self.input_width
        for layer in range(layers):
            if layer == SKIP_LAYER:
                width += self.input_width
            shape = tensors[f"layers.{layer}.weight"].shape
            rows = shape[0] if shape else 0
            _require(rows >= 1, f"layers.{layer}.weight has no rows")
            _check_shape(f"layers.{layer}.weight", tensors, (rows, width))
            _check_shape(f"layers.{layer}.bias", tensors, (rows,))
            width = rows


def parse_description(values: Any) -> NeusFactoDescription:
    """The description from plain (JSON) values.

    Raises FieldFormatError: FIELD_FAMILY_UNKNOWN, or SAFE_FORMAT_INVALID naming the first faulty entry.
    """
    if not isinstance(values, dict):
        raise FieldFormatError("the field's description is not a JSON object", reason="SAFE_FORMAT_INVALID")
    if values.get("family") != "neus_facto":
        raise FieldFormatError(f"unknown field family {values.get('family')!r}", reason="FIELD_FAMILY_UNKNOWN")
    try:
        description = _ADAPTER.validate_python(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise FieldFormatError(f"description.{where}: {first['msg']}", reason="SAFE_FORMAT_INVALID") from error
    lower, upper = description.bounds
    if not all(math.isfinite(a) and math.isfinite(b) and a < b for a, b in zip(lower, upper, strict=True)):
        raise FieldFormatError("description.bounds: not a finite, non-empty box", reason="SAFE_FORMAT_INVALID")
    return description


def description_to_dict(description: NeusFactoDescription) -> dict[str, Any]:
    """Plain (JSON) values of a description, defaults included, in a fixed order."""
    values: dict[str, Any] = _ADAPTER.dump_python(description, mode="json")
    return values


def _check_shape(name: str, tensors: Mapping[str, TensorSpec], expected: tuple[int, ...]) -> None:
    shape = tensors[name].shape
    _require(shape == expected, f"{name} has shape {shape}, its description asks for {expected}")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise FieldFormatError(message, reason="FIELD_SHAPES_MISMATCH")


_ADAPTER = TypeAdapter(NeusFactoDescription)

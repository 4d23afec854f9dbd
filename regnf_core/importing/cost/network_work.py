"""How long fields of layers, grids, blocks and points take: so much a point, from the shapes of their tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping

from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.cost.calls import GRADIENT, Calls
from regnf_core.schema.color import COLOR, NetworkColor
from regnf_core.schema.description import FieldDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.kinds.neural_points import NeuralPointsDescription

_POINT_S, _CORNER_S, _CELL_S = 2e-6, 1.5e-8, 1e-7
"""Seconds: a point, a number read at a corner of a grid's cell, a cell that is looked up."""
_PRODUCT_S, _ACTIVATION_S = 1e-10, 1.5e-8
"""Seconds: a multiplication and addition of a layer, one of its outputs."""
_CORNERS = 8


def network_work(description: FieldDescription, tensors: Mapping[str, StoredArray], calls: Calls) -> float:
    """Seconds that the field's evaluation takes on one core, by a conservative rate."""
    layers: float = sum(_layer(array.shape) for name, array in tensors.items() if name.startswith("layers."))
    grid = getattr(description, "hash", None)
    if isinstance(grid, HashGridConfig):
        layers += grid.levels * grid.features_per_level * _CORNERS * _CORNER_S
    volumes: int = sum(array.shape[-1] for name, array in tensors.items() if name.startswith("volumes.") and array.ndim)
    layers += volumes * _CORNERS * _CORNER_S
    if isinstance(description, NeuralPointsDescription):
        decoded = 1 if description.blend_first else description.neighbors
        each = _POINT_S + decoded * layers + (2 * math.floor(description.reach) + 1) ** 3 * _CELL_S
        return each * GRADIENT * (sum(calls.values) + sum(calls.gradients))
    return (_POINT_S + layers) * calls.points


def color_work(color: NetworkColor, tensors: Mapping[str, StoredArray]) -> float:
    """Seconds that the network of a color takes at a point on one core, beside those of the geometry."""
    layers = sum(_layer(array.shape) for name, array in tensors.items() if name.startswith(f"{COLOR}.layers."))
    width = 0 if color.hash is None else color.hash.width
    return _POINT_S + layers + width * _CORNERS * _CORNER_S


def _layer(shape: tuple[int, ...]) -> float:
    """A weight of two axes is multiplied, a bias added, its result put through an activation."""
    return math.prod(shape) * _PRODUCT_S if len(shape) > 1 else math.prod(shape) * _ACTIVATION_S

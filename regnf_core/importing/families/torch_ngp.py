"""torch-ngp's fields of meshes: a hash grid over [-1, 1]^3 and a ReLU network without biases.

There are two ways in which the trainer evaluates the grid: its own kernel, whose file tells where each level begins,
and tiny-cuda-nn, whose file holds two bare vectors of numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.converted import ConvertedField, Reading, converted_of
from regnf_core.importing.families.grid_search import GridHabits, find_grids, grid_name
from regnf_core.importing.families.layers import Layers, layer_names, read_layers, require_extra_columns, strip_prefix
from regnf_core.importing.families.shared import UNIT_CUBE, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import GridDescription, UploadDescription
from regnf_core.schema.hash_grid_config import HashGridConfig

FAMILY = "torch_ngp"
_OWN, _TCNN = ("encoder.embeddings", "encoder.offsets", "backbone.0.weight"), ("encoder.params", "backbone.params")
_TOPS = (2048, 1024, 512, 4096, 256, 8192, 128)
_HABITS = GridHabits((2, 4, 1, 8), tuple((16, top) for top in _TOPS), "linear")
_USUAL_WIDTHS = (32, 16, 64, 128, 8)
_USUAL_NEURONS = (64, 128, 32, 16)
_MAX_HIDDEN = 8
_PADDING = 16
"""tiny-cuda-nn's fused network takes and gives this many columns, or a multiple."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE,
    HASH_GRID_NOT_RECOGNIZED and what TensorSource raises.
    """
    state = strip_prefix(checkpoint.get("model", checkpoint), "")
    own = all(name in state for name in _OWN)
    if not own and not all(name in state for name in _TCNN):
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("hash",))
    read = _read_own if own else _read_tcnn
    table, layers, grids = read(state, source, overrides.hash)
    entries = {**shared_entries(overrides, UNIT_CUBE), "source": {"family": FAMILY}}
    readings = tuple(
        Reading(
            f"{grid_name(grid)}, growing by {grid.per_level_scale:.6g}",
            {"kind": "grid_mlp", **entries, "hash": asdict(grid)},
            {**layers.tensors(), "hash_table": table.reshape(-1, grid.features_per_level)},
        )
        for grid in grids
    )
    told = "encoder.embeddings with offsets" if own else "encoder.params, backbone.params"
    why = (f"keys {told}, {len(layers.weights)} layers", "bounds [-1, 1]: the cube in which it trains")
    converted = converted_of(FAMILY, why, readings)
    return replace(converted, sign_is_open=True)


_Parts = tuple[Float32Array, Layers, Sequence[HashGridConfig]]


def _read_own(state: dict[str, Any], source: TensorSource, overrides: GridDescription) -> _Parts:
    """Table, network and possible grids of the trainer's own kernel."""
    names = layer_names(state, "backbone.")
    layers = read_layers(state, names, source, has_biases=False)
    require_extra_columns(layers, names)
    table = source.array("encoder.embeddings", state["encoder.embeddings"])
    require_shape("encoder.embeddings", table, (None, None))
    offsets = source.integers("encoder.offsets", state["encoder.offsets"])
    entries = tuple(int(n) for n in np.diff(offsets)) if offsets.ndim == 1 else ()
    levels, features = len(entries), table.shape[1]
    if not entries or offsets[0] != 0 or offsets[-1] != len(table) or min(entries) <= 0:
        raise tensor_error("encoder.offsets do not divide encoder.embeddings into levels", "TENSOR_SHAPE")
    if layers.input_width != levels * features or levels > 32 or features > 32:
        raise tensor_error(f"{levels} levels of {features} features, but {layers.input_width} columns", "TENSOR_SHAPE")
    grids = [grid for grid in _own_grids(levels, features, max(entries), overrides) if grid.level_entries() == entries]
    if not grids:
        raise _not_recognized(f"no usual hash grid has levels of {entries} entries")
    return table, layers, grids


def _own_grids(levels: int, features: int, max_count: int, overrides: GridDescription) -> Iterator[HashGridConfig]:
    """Grids as the trainer lays them out: a level of resolution r has r + 1 nodes along an edge, and rows as long."""
    log2_size = math.ceil(math.log2(max(max_count, 8)))
    if log2_size > 24:
        raise _not_recognized(f"a level of {max_count} entries is larger than any that is taken")
    bases = (16, 8, 32, 4, 64) if overrides.base_resolution is None else (overrides.base_resolution,)
    for base in bases:
        for top in _TOPS if overrides.top_resolution is None else (overrides.top_resolution,):
            growth = float(np.exp2(np.log2(top / base) / max(levels - 1, 1)))
            if not 1.0 <= growth <= 8.0:
                continue
            nodes = tuple(math.ceil(base * growth**level) + 1 for level in range(levels))
            yield HashGridConfig(levels, features, log2_size, base, growth, nodes, None, "linear")


def _read_tcnn(state: dict[str, Any], source: TensorSource, overrides: GridDescription) -> _Parts:
    """Table, network and possible grids of tiny-cuda-nn's encoding and fused network."""
    table = source.array("encoder.params", lookup(state, "encoder.params"))
    network = source.array("backbone.params", lookup(state, "backbone.params"))
    for name, vector in (("encoder.params", table), ("backbone.params", network)):
        require_shape(name, vector, (None,))
    for width in _USUAL_WIDTHS:
        layers = _split(network, width)
        if layers is None:
            continue
        try:
            exact = find_grids(table.size, width, _HABITS, overrides)
        except FieldFormatError:
            continue
        return table, layers, [*_with_short_growth(exact), *exact]
    raise _not_recognized(f"no usual grid and network have {table.size} and {network.size} parameters")


def _with_short_growth(grids: Sequence[HashGridConfig]) -> Iterator[HashGridConfig]:
    """The trainer's configuration gives the growth from level to level with four decimals."""
    for grid in grids:
        short = replace(grid, per_level_scale=round(grid.per_level_scale, 4))
        if grid.resolutions is None and grid.strides is None and short.level_entries() == grid.level_entries():
            yield short


def _split(network: Float32Array, width: int) -> Layers | None:
    """The fused network's layers, row-major and without biases; None where no usual network has that size.

    Columns beyond ``width`` are always fed ones, so they are a bias; of the result only row 0 is used.
    """
    padded = -(-width // _PADDING) * _PADDING
    for neurons in _USUAL_NEURONS:
        hidden, rest = divmod(network.size - (padded + _PADDING) * neurons, neurons * neurons)
        if rest or not 0 <= hidden < _MAX_HIDDEN:
            continue
        shapes = [(neurons, padded), *[(neurons, neurons)] * hidden, (_PADDING, neurons)]
        ends = np.cumsum([rows * columns for rows, columns in shapes])[:-1]
        weights = [part.reshape(shape) for part, shape in zip(np.split(network, ends), shapes, strict=True)]
        biases = [np.zeros(rows, dtype=np.float32) for rows, _ in shapes]
        biases[0] = weights[0][:, width:].sum(axis=1, dtype=np.float32)
        weights[0] = np.ascontiguousarray(weights[0][:, :width])
        return Layers((*weights[:-1], weights[-1][:1]), (*biases[:-1], biases[-1][:1]))
    return None


def _not_recognized(message: str) -> FieldFormatError:
    return FieldFormatError(f"{message}; describe it under 'hash'", reason="HASH_GRID_NOT_RECOGNIZED")

"""nerfstudio's nerfacto (and its instant-ngp, which has the same field): a density behind a hash grid.

Three releases' names, in plain PyTorch or as one or two vectors of tiny-cuda-nn. Color, appearance, proposal networks
and corrected poses are left behind: where a camera stands a little beside its own image, it sees the same density.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import require_shape
from regnf_core.importing.families.layers import (
    Layers,
    contradiction,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    strip_prefix,
)
from regnf_core.importing.families.radiance_field import Radiance
from regnf_core.importing.radiance.density import Level, Pairs, RadianceField, fused_layers, plain_levels, tiny_levels
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.hash_grid_config import HashGridConfig

FAMILY = "nerfstudio_nerfacto"
_PREFIXES = ("_model.field.", "_model.module.field.", "module._model.field.")
_CONTRACTED = 2.0
"""Half an edge of contracted space; also of the cube of plain space in which a surface is looked for, since the poses
are within [-1, 1]^3."""
_NEAR = 0.05
"""From where on the trainer samples rays."""
_OTHER = "mlp_background_color."
"""Of generfacto, whose other tensors have the same names."""
_BLOCK, _WIDTHS = 16, (64, 128, 256, 32, 16)
_BASE, _FARTHEST = 16, 1e6
_DENSITY = 0.01
"""``average_init_density`` of the usual configurations, since releases have it."""


@dataclass(frozen=True)
class _Names:
    """Of tensors: grid and network may be in one. has_factor: whether releases with these names may multiply the
    density."""

    table: str
    network: str
    tiny: bool
    has_factor: bool = False


_NAMES = (
    _Names("mlp_base.model.0.hash_table", "mlp_base.model.1.layers.", tiny=False, has_factor=True),
    _Names("mlp_base.model.params", "mlp_base.model.params", tiny=True, has_factor=True),
    _Names("mlp_base.0.hash_table", "mlp_base.1.layers.", tiny=False),
    _Names("mlp_base.0.tcnn_encoding.params", "mlp_base.1.tcnn_encoding.params", tiny=True),
    _Names("mlp_base.params", "mlp_base.params", tiny=True),
)


def read_radiance(checkpoint: Any, source: TensorSource, overrides: UploadDescription) -> Radiance | None:
    """The density of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, HASH_GRID_NOT_RECOGNIZED, SETTINGS_CONTRADICT_TENSORS and what
    TensorSource raises.
    """
    state, names = _named(checkpoint) if isinstance(checkpoint, dict) else ({}, None)
    if names is None:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("hash", "contraction", "output_scale"))
    assumed: list[str] = []
    levels, layers, told = _density(state, names, source, overrides, assumed)
    contracted = overrides.contraction != "none"
    if overrides.contraction is None:
        assumed.append("space is contracted")
    factor = overrides.output_scale or (_DENSITY if names.has_factor else 1.0)
    if overrides.output_scale is None and names.has_factor:
        assumed.append(f"average_init_density is {_DENSITY}")
    edge = np.full(3, _CONTRACTED if contracted else 1.0)
    low, high = -edge, edge
    if not contracted and "aabb" in state:
        box = source.array("aabb", state["aabb"])
        require_shape("aabb", box, (2, 3))
        low, high = box.astype(np.float64)
        if not (low < high).all() or np.abs(box).max() > _FARTHEST:
            raise FieldFormatError("the aabb is empty, or too far away", reason="BOUNDS_INVALID")
    kind = "tiny-cuda-nn's layout" if names.tiny else "plain PyTorch's layout"
    why = f"tensors {names.table.rpartition('.')[0]}*, {kind}: {told}, {len(layers)} layers"
    text = "without config.yml the trainer's defaults are taken: " + ", ".join(assumed)
    field = RadianceField(levels, layers, low, high, contracted, factor, _NEAR)
    return Radiance(FAMILY, field, (low, high), why, (f"SETTINGS_ASSUMED: {text}",) if assumed else ())


def _named(checkpoint: dict[Any, Any]) -> tuple[dict[str, Any], _Names | None]:
    """The field's tensors and their names; None of other checkpoints."""
    for prefix in _PREFIXES:
        state = strip_prefix(checkpoint.get("pipeline"), prefix)
        for names in _NAMES:
            if names.table in state and not any(key.startswith(_OTHER) for key in state):
                return state, names
    return {}, None


def _density(
    state: dict[str, Any], names: _Names, source: TensorSource, overrides: UploadDescription, assumed: list[str]
) -> tuple[tuple[Level, ...], Pairs, str]:
    """The grid, the network, and a few words. What nobody says goes to ``assumed``."""
    table = source.array(names.table, state[names.table])
    require_shape(names.table, table, (None,) if names.tiny else (None, None))
    grid, top = _grid(state, source, overrides, 2 if names.tiny else table.shape[1], assumed)
    told = f"{grid.levels} levels of {grid.features_per_level}, {grid.base_resolution} to {top} nodes"
    if not names.tiny:
        if table.shape != (grid.levels << grid.log2_table_size, grid.features_per_level):
            raise contradiction("hash", f"{grid.levels} levels of 2^{grid.log2_table_size} entries", f"{table.shape}")
        plain = _plain_network(state, names.network, source, grid.width)
        layers = tuple(zip(plain.weights, plain.biases, strict=True))
        return plain_levels(grid.base_resolution, top, table, grid.levels), layers, told
    if grid.width % _BLOCK:
        message = f"a hash grid of {grid.width} columns, which tiny-cuda-nn fills up, is not supported: export a mesh"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    sizes = [width * (grid.width + _BLOCK) for width in _WIDTHS]
    if names.network != names.table:
        own = source.array(names.network, state.get(names.network)).ravel()
        table, sizes = np.concatenate([own, table]), [own.size]
    for size in sizes:  # of the network, which comes first: the number of its neurons is not stored
        entries, rest = divmod(table.size - size, grid.features_per_level)
        with contextlib.suppress(FieldFormatError):
            if not rest:
                fitting = grid.with_entry_count(entries)
                return tiny_levels(fitting, table[size:]), fused_layers(table[:size], grid.width, 1), told
    raise _not_recognized(f"{table.size} numbers")


def _plain_network(state: dict[str, Any], prefix: str, source: TensorSource, width: int) -> Layers:
    names = layer_names(state, prefix)
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names)
    if layers.input_width != width:
        raise contradiction("hash.levels x hash.features_per_level", width, f"{layers.input_width} columns")
    return layers


def _grid(
    state: dict[str, Any], source: TensorSource, overrides: UploadDescription, features: int, assumed: list[str]
) -> tuple[HashGridConfig, int]:
    """The grid and its finest resolution, by what the description and the checkpoint say, which must agree."""
    said = overrides.hash
    if said.interpolation not in (None, "linear") or said.radius is not None or said.per_level_scale is not None:
        message = f"description.hash: interpolation, radius and per_level_scale are not possible for {FAMILY}"
        raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
    levels = _stored(state, "num_levels", source, said.levels, 16, (1, 32))
    log2 = _stored(state, "log2_hashmap_size", source, said.log2_table_size, 19, (3, 24))
    top = _stored(state, "max_res", source, said.top_resolution, 2048, (2, 1 << 20))
    base = said.base_resolution or _BASE
    if said.base_resolution is None:
        assumed.append(f"the coarsest level has {_BASE} nodes")
    if top < base:
        raise contradiction("hash.top_resolution", top, f"a coarsest level of {base} nodes")
    values = {"levels": levels, "features_per_level": said.features_per_level or features, "log2_table_size": log2}
    return HashGridConfig.from_top_resolution(top, base_resolution=base, interpolation="linear", **values), top


def _stored(
    state: dict[str, Any], name: str, source: TensorSource, said: int | None, usual: int, limits: tuple[int, int]
) -> int:
    """A whole number that checkpoints since 2023 have; before, what is said, or the usual one."""
    if name not in state:
        return said or usual
    stored = source.integers(name, state[name])
    value = int(stored.reshape(-1)[0]) if stored.size == 1 else -1
    if not limits[0] <= value <= limits[1]:
        raise _not_recognized(f"{name} {value}")
    if said not in (None, value):
        raise contradiction(name, said, value)
    return value


def _not_recognized(found: str) -> FieldFormatError:
    message = (
        f"no hash grid of nerfacto has {found}: give config.yml beside the checkpoint, or the import options "
        f"hash.levels, features_per_level, log2_table_size, base_resolution and top_resolution"
    )
    return FieldFormatError(message, reason="HASH_GRID_NOT_RECOGNIZED")

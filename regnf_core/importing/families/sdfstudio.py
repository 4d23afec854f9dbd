"""neus-facto and its kin as sdfstudio and nerfstudio save them: a hash grid and a small network under ``_model.field.``

The two trainers write the same keys and shapes for different functions: nerfstudio multiplies the sines' argument by
2 pi and contracts space for the grid alone. Only sdfstudio's field has a ``laplace_density``, which decides; the
uploader may overrule. Training state, color, background, proposal networks and image losses are left behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import require_shape
from regnf_core.importing.families.converted import ConvertedField, Reading, converted_of
from regnf_core.importing.families.grid_field import grid_readings
from regnf_core.importing.families.grid_search import GridHabits, find_grids
from regnf_core.importing.families.layers import Layers, layer_names, read_layers, require_extra_columns, strip_prefix
from regnf_core.importing.families.shared import UNIT_CUBE, refuse_other_entries, shared_entries
from regnf_core.importing.pickle.pickle_values import GlobalRef, Placeholder
from regnf_core.importing.tensor_source import TensorSource, as_tensor, lookup
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.hash_grid_config import HashGridConfig
from regnf_core.schema.kinds.neus_facto import SKIP_LAYER

_PREFIXES = ("_model.field.", "_model.module.field.")
_DEGREE = 6
_PLAIN_WIDTH = 3 + 6 * _DEGREE
_FACTO = GridHabits((2, 4, 8, 1), ((16, 2048), (16, 1024), (16, 4096), (32, 2048), (16, 512), (64, 4096)), "smoothstep")
_ANGELO = GridHabits((8, 4, 2, 1), ((64, 4096), (32, 4096), (16, 4096), (16, 2048), (32, 2048), (16, 512)), "linear")


@dataclass(frozen=True)
class _Variant:
    """One function behind the shared keys."""

    name: str
    two_pi: bool
    contraction: str
    habits: GridHabits


_VARIANTS = {
    variant.name: variant
    for variant in (
        _Variant("sdfstudio_neus_facto", False, "none", _FACTO),
        _Variant("sdfstudio_neus_facto_angelo", False, "none", _ANGELO),
        _Variant("sdfstudio_neus", False, "none", _FACTO),
        _Variant("nerfstudio_neus_facto", True, "linf_grid", _FACTO),
    )
}


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE, HASH_GRID_NOT_RECOGNIZED and what
    TensorSource raises.
    """
    pipeline = checkpoint.get("pipeline")
    if isinstance(pipeline, (Placeholder, GlobalRef)):
        as_tensor("pipeline", pipeline)
    prefix = next((p for p in _PREFIXES if strip_prefix(pipeline, p + "glin")), None)
    if prefix is None:
        return None
    state = strip_prefix(pipeline, prefix)
    refuse_other_entries(overrides, "a checkpoint of sdfstudio or nerfstudio", ("contraction", "level_mask", "hash"))
    names = layer_names(state, "glin")
    variant, why = _tell_variant(state, len(names), overrides)
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names, {SKIP_LAYER: layers.input_width})
    evidence = (f"keys {prefix}glin*, {len(names)} layers", why)
    return _assemble(state, layers, variant, evidence, source, overrides)


def _tell_variant(state: dict[str, Any], layers: int, overrides: UploadDescription) -> tuple[_Variant, str]:
    if overrides.family is not None:
        if overrides.family not in _VARIANTS:
            message = f"the file is one of {sorted(_VARIANTS)}, the description says {overrides.family}"
            raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
        return _VARIANTS[overrides.family], "the description names the family"
    if not any(key.startswith("laplace_density.") for key in state):
        return _VARIANTS["nerfstudio_neus_facto"], "no laplace_density: nerfstudio, not sdfstudio"
    name = "sdfstudio_neus_facto"
    if layers == 2:
        name = "sdfstudio_neus_facto_angelo"
    elif layers > SKIP_LAYER:
        name = "sdfstudio_neus"
    return _VARIANTS[name], "laplace_density: sdfstudio, not nerfstudio"


def _assemble(
    state: dict[str, Any],
    layers: Layers,
    variant: _Variant,
    why: tuple[str, ...],
    source: TensorSource,
    overrides: UploadDescription,
) -> ConvertedField:
    warnings: list[str] = []
    width = layers.input_width - _PLAIN_WIDTH
    if width <= 0:
        message = f"{layers.input_width} inputs; expected {_PLAIN_WIDTH} of the position and those of a hash grid"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    table = source.array("encoding.params", lookup(state, "encoding.params"))
    require_shape("encoding.params", table, (None,))
    uses_sines = _uses_columns(layers, 3, _PLAIN_WIDTH)
    entries = {
        **shared_entries(overrides, _bounds(state, source, overrides, warnings)),
        "positional_encoding": {"degree": _DEGREE, "two_pi": variant.two_pi, "used": uses_sines},
        "contraction": overrides.contraction or variant.contraction,
        "level_mask": overrides.level_mask,
        "source": {"family": variant.name},
    }
    if _uses_columns(layers, _PLAIN_WIDTH, None):
        grids = find_grids(table.size, width, variant.habits, overrides.hash)
        readings = grid_readings(table, grids, layers.tensors(), entries)
    else:
        unused = asdict(_unused_grid(table.size, width, variant, overrides))
        description = {"kind": "neus_facto", **entries, "hash": unused, "use_grid": False}
        readings = (Reading("no grid", description, layers.tensors()),)
    return converted_of(variant.name, why, readings, tuple(warnings))


def _uses_columns(layers: Layers, start: int, stop: int | None) -> bool:
    """Whether these columns of the input have any weight: unused encodings keep the zeros they began with."""
    seen = [layers.weights[0]]
    if len(layers.weights) > SKIP_LAYER:
        seen.append(layers.weights[SKIP_LAYER][:, -layers.input_width :])
    return any(bool(weight[:, start:stop].any()) for weight in seen)


def _unused_grid(size: int, width: int, variant: _Variant, overrides: UploadDescription) -> HashGridConfig:
    """A grid that stands for the columns alone: no table is kept."""
    try:
        return find_grids(size, width, variant.habits, overrides.hash)[0]
    except FieldFormatError:
        if width > 32:
            raise
        return HashGridConfig(levels=width, features_per_level=1)


def _bounds(
    state: dict[str, Any], source: TensorSource, overrides: UploadDescription, warnings: list[str]
) -> Sequence[Sequence[float]]:
    if "aabb" not in state:
        if overrides.bounds is None:
            warnings.append("BOUNDS_ASSUMED: the checkpoint has no aabb; [-1, 1] is assumed along every axis")
        return UNIT_CUBE
    box = source.array("aabb", state["aabb"])
    require_shape("aabb", box, (2, 3))
    if not (box[0] < box[1]).all():
        raise FieldFormatError("the aabb is empty", reason="BOUNDS_INVALID")
    return [[float(v) for v in corner] for corner in box]

"""neus-facto and its kin as sdfstudio and nerfstudio save them: a hash grid and a small network under ``_model.field.``

The two trainers write the same keys and shapes for different functions: nerfstudio multiplies the sines' argument by
2 pi and contracts space for the grid alone. Only sdfstudio's field has a ``laplace_density``, which decides; the
uploader may overrule. Training state, background, proposal networks and image losses are left behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape
from regnf_core.importing.families.color import studio
from regnf_core.importing.families.color.head import ASSUMED, with_color, with_deviation
from regnf_core.importing.families.converted import ConvertedField, Reading, converted_of
from regnf_core.importing.families.grid_search import GridHabits, find_spaces, most_usual, space_readings
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    contradiction,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.pickle.pickle_machine import GlobalRef, Placeholder
from regnf_core.importing.tensor_source import TensorSource, as_tensor, lookup
from regnf_core.importing.upload_description import GridDescription, UploadDescription
from regnf_core.schema.description import COLOR
from regnf_core.schema.kinds import SKIP_LAYER

_RADIUS = 2.0
"""Half an edge of the cube that the grid covers: contracted space."""
_PREFIX = "_model.field."
_DEGREES = (6, 4, 8, 10, 5, 7, 9, 3, 2, 1, 0)
"""Of the sines and cosines: the usual number of frequencies first."""
_FACTO = GridHabits((2, 4, 8, 1), "smoothstep")
_ANGELO = GridHabits((8, 4, 2, 1), "linear")
_UNTRAINED = 1.01e-4
"""tiny-cuda-nn begins with features between -1e-4 and 1e-4."""


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
    if not strip_prefix(pipeline, f"{_PREFIX}glin"):
        return None
    state = strip_prefix(pipeline, _PREFIX)
    refuse_other_entries(
        overrides,
        "a checkpoint of sdfstudio or nerfstudio",
        ("contraction", "level_mask", "hash", "use_grid", "positional_encoding"),
    )
    names = layer_names(state, "glin")
    variant, why = _tell_variant(state, len(names), overrides)
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names, {SKIP_LAYER: layers.input_width})
    evidence = (f"keys {_PREFIX}glin*, {len(names)} layers", why)
    converted = _assemble(state, layers, variant, evidence, source, overrides)
    converted = with_deviation(converted, state, "deviation_network.variance", source)
    if not studio.has_color(state) or overrides.color.keep is False:
        return converted
    color, two_pi = overrides.color, variant.two_pi
    converted = with_color(converted, lambda: studio.read_color(state, names[-1], source, color, two_pi))
    assumed = studio.assumed_of(state, color)
    if assumed is None or COLOR not in converted.description:
        return converted
    return replace(converted, warnings=(*converted.warnings, f"{ASSUMED}: {assumed}"))


def _tell_variant(state: dict[str, Any], layers: int, overrides: UploadDescription) -> tuple[_Variant, str]:
    if overrides.family is not None:
        if overrides.family not in _VARIANTS:
            message = f"the file is one of {sorted(_VARIANTS)}, the import options have {overrides.family}"
            raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
        return _VARIANTS[overrides.family], "the family is from the import options or the config file"
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
    table = source.array("encoding.params", lookup(state, "encoding.params"))
    require_shape("encoding.params", table, (None,))
    bounds = _bounds(state, source, overrides, warnings)
    readings: list[Reading] = []
    for degree in _possible_degrees(layers, overrides):
        readings += _readings(table, layers, variant, degree, bounds, overrides)
    if not readings:
        find_spaces(table.size, layers.input_width - 3 - 6 * _DEGREES[0], variant.habits, overrides.hash)
    return converted_of(variant.name, why, most_usual(readings), tuple(warnings))


def _possible_degrees(layers: Layers, overrides: UploadDescription) -> list[int]:
    """Numbers of frequencies that leave columns for a grid, the most usual first."""
    said = overrides.positional_encoding.degree
    possible = [d for d in (_DEGREES if said is None else (said,)) if layers.input_width > 3 + 6 * d]
    if said is None and layers.input_width == 3 + 6 * _DEGREES[0]:
        possible = []  # the usual sines, and no grid
    if not possible and said is not None:
        raise contradiction("positional_encoding.degree", said, f"{layers.input_width} columns in the first layer")
    if not possible:
        message = f"{layers.input_width} inputs; expected those of the position, its sines and a hash grid"
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    return possible


def _readings(
    table: Float32Array,
    layers: Layers,
    variant: _Variant,
    degree: int,
    bounds: Sequence[Sequence[float]],
    overrides: UploadDescription,
) -> list[Reading]:
    """The functions that the tensors may stand for if the position has ``degree`` frequencies."""
    plain = 3 + 6 * degree
    two_pi = overrides.positional_encoding.two_pi
    entries = {
        **shared_entries(overrides, bounds),
        "grid_radius": overrides.hash.radius or _RADIUS,
        "positional_encoding": {
            "degree": degree,
            "two_pi": variant.two_pi if two_pi is None else two_pi,
            "used": overrides.positional_encoding.used is not False and _uses_columns(layers, 3, plain),
        },
        "contraction": overrides.contraction or variant.contraction,
        "level_mask": overrides.level_mask,
        "source": {"family": variant.name},
    }
    usual = degree == _DEGREES[0] or overrides.positional_encoding.degree is not None
    try:
        spaces = find_spaces(table.size, layers.input_width - plain, variant.habits, overrides.hash)
    except FieldFormatError:
        if overrides.hash != GridDescription() and usual:
            raise
        return []
    readings: list[Reading] = []
    is_trained = bool(np.abs(table).max() > _UNTRAINED)
    if overrides.use_grid is not False and _uses_columns(layers, plain, None):
        readings += space_readings(
            table, spaces, layers.tensors(), entries, "open" if overrides.hash.interpolation is None else "known"
        )
    may_be_unused = overrides.use_grid is not True and (not is_trained or len(layers.weights) > SKIP_LAYER)
    if not readings or may_be_unused:  # columns of zeros never see the grid, whatever is said
        unused = spaces[0].written[0].grid.described()
        description = {"kind": "neus_facto", **entries, "hash": unused, "use_grid": False}
        readings.append(Reading("no grid", description, layers.tensors(), {"use_grid": False}))
    told = {"positional_encoding": {"degree": degree}}
    more = 0 if usual else 1
    return [replace(r, say={**r.say, **told} if more else r.say, tier=r.tier + more) for r in readings]


def _uses_columns(layers: Layers, start: int, stop: int | None) -> bool:
    """Whether these columns of the input have any weight: unused encodings keep the zeros they began with."""
    seen = [layers.weights[0]]
    if len(layers.weights) > SKIP_LAYER:
        seen.append(layers.weights[SKIP_LAYER][:, -layers.input_width :])
    return any(bool(weight[:, start:stop].any()) for weight in seen)


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

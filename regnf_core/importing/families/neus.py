"""NeuS (Wang et al. 2021): softplus layers. Its ``scale`` is not in the checkpoint: S(x) = f(scale x) / scale."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.color import neus as color
from regnf_core.importing.families.color.head import ReadColor, understood, with_color, with_deviation
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    assumed_bounds,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.families.network import (
    BETA,
    FORM_ENTRIES,
    Form,
    Network,
    form_variant,
    network_field,
    skips_of,
)
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "neus"
_SCALES = (1.0, 3.0)
"""Those of the published configurations. Nothing tells them apart: the gradient is as long at every scale."""
MAX_DEGREE = 24


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of a NeuS, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE, SETTINGS_CONTRADICT_TENSORS,
    INVALID_DESCRIPTION and what TensorSource raises.
    """
    if "sdf_network_fine" not in checkpoint:
        return None
    require_family(overrides, FAMILY)
    state = strip_prefix(checkpoint["sdf_network_fine"], "")
    converted = _converted(state, source, overrides)
    sharpness = strip_prefix(checkpoint.get("variance_network_fine"), "")
    converted = with_deviation(converted, sharpness, "variance", source)
    colors = strip_prefix(checkpoint.get("color_network_fine"), "")
    if not colors or overrides.color.keep is False:
        return converted
    return _with_color(converted, state, colors, source, overrides)


def _with_color(
    converted: ConvertedField,
    state: dict[str, Any],
    colors: dict[str, Any],
    source: TensorSource,
    overrides: UploadDescription,
) -> ConvertedField:
    last = len(layer_names(state, "lin")) - 1
    is_softplus = overrides.activation in (None, "softplus")

    def read() -> ReadColor:
        understood(not overrides.output_column, "the distance is not the first output of the network")
        understood(last not in converted.description["input_at"], "the last layer uses the position again")
        return color.read_color(colors, state, f"lin{last}", source, overrides.color)

    # Softplus of another factor is stored as that of the usual one, of other numbers.
    return with_color(converted, read, BETA / (overrides.activation_scale or BETA) if is_softplus else 1.0)


def _converted(state: dict[str, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField:
    refuse_other_entries(overrides, FAMILY, FORM_ENTRIES)
    names = layer_names(state, "lin", minimum=2)
    layers = read_layers(state, names, source, column=overrides.output_column or 0)
    degree, rest = divmod(layers.input_width - 3, 6)
    if rest or not 0 <= degree <= MAX_DEGREE:
        raise tensor_error(f"lin0 has {layers.input_width} columns, expected 3 + 6 x frequencies", "TENSOR_SHAPE")
    network, entries = Network(layers, skips_of(layers, names)), shared_entries(overrides, UNIT_CUBE)
    form = Form("softplus", degree=degree, skip_factor=math.sqrt(0.5)).said(scaled(overrides))
    why = (f"keys sdf_network_fine.lin*, {len(names)} layers, {degree} frequencies", *assumed_bounds(overrides))
    converted = network_field(network, form, FAMILY, entries, why)
    if overrides.input_scale is not None or overrides.output_scale is not None:
        return converted
    forms = [replace(form, input_scale=scale, output_scale=1.0 / scale) for scale in _SCALES]
    untold = tuple(form_variant(network, one, FAMILY, entries, input_scale=one.input_scale) for one in forms)
    return replace(converted, untold=untold)


def scaled(overrides: UploadDescription) -> UploadDescription:
    """With both factors where one is said: S(x) = f(s x) / s."""
    given, made = overrides.input_scale, overrides.output_scale
    if given is not None and made is None:
        return replace(overrides, output_scale=1.0 / given)
    if made is not None and given is None:
        return replace(overrides, input_scale=1.0 / made)
    return overrides

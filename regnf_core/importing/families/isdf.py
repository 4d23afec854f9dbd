"""iSDF (Ortiz et al. 2022): a softplus network of the position and its sines along 21 directions.

Two factors of its configuration are in no file: that of the coordinates before they are encoded, and that of the
result. Nor is the transform from the world to the frame in which it trains, that of the scene's box: the field is in
that frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.families.network import FORM_ENTRIES, Form, Network, OpenForm, network_field, told
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "isdf"
_INPUT_SCALE, _OUTPUT_SCALE = 0.05937489, 0.14
_DIRECTIONS = 21
_REACH = 4.0
"""Half an edge of the bounds that are assumed, meters: a room's."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and what
    TensorSource raises.
    """
    state = strip_prefix(checkpoint.get("model_state_dict"), "")
    if not strip_prefix(state, "in_layer.") or not strip_prefix(state, "out_alpha."):
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, FORM_ENTRIES)
    if any("B_layer" in name for name in state):
        raise FieldFormatError("an encoding along random directions is not supported", reason="FAMILY_NOT_SUPPORTED")
    first, second = (_names(state, block) for block in ("mid1.", "mid2."))
    names = ["in_layer.0", *first, "cat_layer.0", *second, "out_alpha"]
    layers = read_layers(state, names, source, column=overrides.output_column or 0)
    again = 1 + len(first)
    require_extra_columns(layers, names, {again: layers.input_width})
    degree, rest = divmod(layers.input_width - 3, 2 * _DIRECTIONS)
    if rest or degree < 1:
        message = f"in_layer.0 has {layers.input_width} columns, expected 3 and {2 * _DIRECTIONS} for each frequency"
        raise tensor_error(message, "TENSOR_SHAPE")
    usual = Form("softplus", degree=degree, order="kind", off_axis=True)
    form = replace(usual, input_scale=_INPUT_SCALE, output_scale=_OUTPUT_SCALE).said(overrides)
    why = (
        f"keys in_layer, cat_layer and out_alpha, {degree} frequencies along {_DIRECTIONS} directions",
        f"coordinates times {form.input_scale:g}, results times {form.output_scale:g}: {_told(overrides)}",
    )
    assumed = overrides.input_scale is None or overrides.output_scale is None
    name = told(input_scale=form.input_scale, output_scale=form.output_scale)
    entries = shared_entries(overrides, [[-_REACH] * 3, [_REACH] * 3])
    converted = network_field(Network(layers, (again,)), [OpenForm(name, form, FAMILY)], entries, why, assumed)
    return replace(converted, warnings=_warnings(overrides))


def _names(state: dict[str, Any], block: str) -> list[str]:
    """The layers of one of the two blocks, which may have none."""
    return [f"{name}.0" for name in layer_names(state, block, minimum=0)]


def _told(overrides: UploadDescription) -> str:
    said = [name for name in ("input_scale", "output_scale") if getattr(overrides, name) is not None]
    return f"{' and '.join(said)} as the description says" if said else "the usual ones"


def _warnings(overrides: UploadDescription) -> tuple[str, ...]:
    if overrides.bounds is not None:
        return ()
    return (f"BOUNDS_ASSUMED: no file says how large the scene is; [-{_REACH:g}, {_REACH:g}] along every axis",)

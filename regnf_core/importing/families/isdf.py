"""iSDF (Ortiz et al. 2022): a softplus network of the position and its sines along 21 directions.

Two factors of its configuration are in no file: that of the coordinates before they are encoded, and that of the
result. Nor is the transform from the world to the frame in which it trains, that of the scene's box: the field is in
that frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import Layers, layer_names, read_layers, require_extra_columns, strip_prefix
from regnf_core.importing.families.shared import refuse_other_entries, require_family, shared_entries
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
    refuse_other_entries(overrides, FAMILY, ("input_scale", "output_scale"))
    if any("B_layer" in name for name in state):
        raise FieldFormatError("an encoding along random directions is not supported", reason="FAMILY_NOT_SUPPORTED")
    first, second = (_names(state, block) for block in ("mid1.", "mid2."))
    names = ["in_layer.0", *first, "cat_layer.0", *second, "out_alpha"]
    layers = read_layers(state, names, source)
    again = 1 + len(first)
    require_extra_columns(layers, names, {again: layers.input_width})
    degree, rest = divmod(layers.input_width - 3, 2 * _DIRECTIONS)
    if rest or degree < 1:
        message = f"in_layer.0 has {layers.input_width} columns, expected 3 and {2 * _DIRECTIONS} for each frequency"
        raise tensor_error(message, "TENSOR_SHAPE")
    scale = overrides.input_scale or _INPUT_SCALE
    description = {
        "kind": "mlp",
        **shared_entries(overrides, [[-_REACH] * 3, [_REACH] * 3]),
        "activation": "softplus",
        "positional_encoding": {"degree": degree, "base_frequency": scale, "off_axis": True},
        "input_at": [again],
        "source": {"family": FAMILY},
    }
    factor = overrides.output_scale or _OUTPUT_SCALE
    why = (
        f"keys in_layer, cat_layer and out_alpha, {degree} frequencies along {_DIRECTIONS} directions",
        f"coordinates times {scale:g}, results times {factor:g}: {_told(overrides)}",
    )
    tensors = _with_input_scaled(layers, again, scale).times(factor).tensors()
    return ConvertedField(FAMILY, why, description, tensors, _warnings(overrides))


def _names(state: dict[str, Any], block: str) -> list[str]:
    """The layers of one of the two blocks, which may have none."""
    return [f"{name}.0" for name in layer_names(state, block, minimum=0)]


def _with_input_scaled(layers: Layers, again: int, scale: float) -> Layers:
    """The position's own columns, of the two layers that see the input, times ``scale``."""
    weights = list(layers.weights)
    for layer in (0, again):
        start = weights[layer].shape[1] - layers.input_width
        scaled = weights[layer].astype(np.float32, copy=True)
        scaled[:, start : start + 3] *= np.float32(scale)
        weights[layer] = scaled
    return Layers(tuple(weights), layers.biases)


def _told(overrides: UploadDescription) -> str:
    said = [name for name in ("input_scale", "output_scale") if getattr(overrides, name) is not None]
    return f"{' and '.join(said)} as the description says" if said else "the usual ones"


def _warnings(overrides: UploadDescription) -> tuple[str, ...]:
    if overrides.bounds is not None:
        return ()
    return (f"BOUNDS_ASSUMED: no file says how large the scene is; [-{_REACH:g}, {_REACH:g}] along every axis",)

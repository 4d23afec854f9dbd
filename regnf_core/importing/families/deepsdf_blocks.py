"""DeepSDF as widespread later code writes it: blocks ``net.*.0`` of a layer and ReLU, ``final_layer.0`` and one tanh.

A narrower ``skip_layer.0``, behind which the network sees its input again, is in the file even where it is not used,
and nothing says behind which block it is: if several places fit, it is asked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import require_shape, tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.deepsdf import at_code, latent_code
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    folded_weight,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_family,
    shared_entries,
    states,
    strip_prefix,
)
from regnf_core.importing.families.network import FORM_ENTRIES, Form, Network, form_variant, network_field
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "deepsdf_blocks"
_USUAL = 3
"""How many blocks usually stand before the narrower layer."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of one shape, or None where the keys are not theirs.

    Raises FieldFormatError: LATENT_MISSING, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and what TensorSource
    raises.
    """
    found = [state for _, state in states(checkpoint) if "final_layer.0.bias" in state and "net.0.0.bias" in state]
    if len(found) != 1:
        return None
    (state,) = found
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("latent", "latent_index", "skip_layer", *FORM_ENTRIES))
    blocks = [f"net.{name}.0" for name in layer_names(strip_prefix(state, "net."), "", minimum=1)]
    plain = read_layers(state, [*blocks, "final_layer.0"], source, column=overrides.output_column or 0)
    width = plain.input_width - 3
    if width < 0 or any(plain.extra_columns):
        raise tensor_error("net: a block does not continue the one before", "TENSOR_SHAPE")
    latent, whence = latent_code(checkpoint, source, overrides, width)
    form = replace(Form("relu"), output_tanh=1 if overrides.output_tanh is None else overrides.output_tanh)
    form = form.said(overrides)
    entries = shared_entries(overrides, UNIT_CUBE)
    places = [
        (place, Network(at_code(layers, latent, (0, *skips)), skips))
        for place, layers, skips in _readings(state, plain, source, overrides)
    ]
    if not places:
        raise FieldFormatError("description.skip_layer: there is no such place", reason="INVALID_DESCRIPTION")
    why = (
        f"keys net.*.0 and final_layer.0, {len(blocks)} blocks",
        whence,
        "bounds [-1, 1]: the cube round the unit sphere, into which shapes are scaled",
    )
    converted = network_field(places[0][1], form, FAMILY, entries, why)
    if len(places) == 1:
        return converted
    untold = tuple(form_variant(network, form, FAMILY, entries, skip_layer=place) for place, network in places)
    return replace(converted, untold=untold)


def _readings(
    state: dict[str, Any], plain: Layers, source: TensorSource, overrides: UploadDescription
) -> list[tuple[int, Layers, tuple[int, ...]]]:
    """How many blocks stand before the narrower layer (0: it is not used), the layers, and which see the input."""
    found: list[tuple[int, Layers, tuple[int, ...]]] = [(0, plain, ())]
    if any(name.startswith("skip_layer.0.") for name in state):
        weight = folded_weight(state, "skip_layer.0", source)
        bias = source.array("skip_layer.0.bias", lookup(state, "skip_layer.0.bias"))
        require_shape("skip_layer.0.bias", bias, (weight.shape[0],))
        for place in sorted(range(1, len(plain.weights)), key=lambda place: (place != _USUAL, place)):
            weights = (*plain.weights[:place], weight, *plain.weights[place:])
            biases = (*plain.biases[:place], bias, *plain.biases[place:])
            layers = Layers(weights, biases)
            extra = [i for i, columns in enumerate(layers.extra_columns) if columns]
            if extra == [place + 1] and layers.extra_columns[place + 1] == plain.input_width:
                found.append((place, layers, (place + 1,)))
        found.sort(key=lambda one: one[0] != _USUAL)
    return [one for one in found if overrides.skip_layer in (None, one[0])]

"""DeepSDF (Park et al. 2019): one network for many shapes, which sees [latent code, position].

The authors' code saves the network and the codes in two files. One upload holds both (``model_state_dict`` and
``latent_codes`` in one dictionary), or it is the network alone and the description gives the code. The code of one
shape is constant, so it is folded into the biases, and what remains is a field.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    Layers,
    folded_weight,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.families.network import FORM_ENTRIES, Form, Network, form_variant, network_field
from regnf_core.importing.pickle.pickle_machine import TensorRef
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "deepsdf"
_CODES = "latent_codes"


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of one shape, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, LATENT_MISSING, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and
    what TensorSource raises.
    """
    network = checkpoint.get("model_state_dict")
    if not strip_prefix(network, "lin"):
        _refuse_codes_alone(checkpoint)
        return None
    refuse_other_entries(overrides, FAMILY, ("latent", "latent_index", *FORM_ENTRIES))
    state = strip_prefix(network, "")
    names = layer_names(state, "lin")
    layers = read_layers(state, names, source, column=overrides.output_column or 0)
    norms = _norms(state, layers, source)
    require_family(overrides, FAMILY)
    if overrides.family is None and not norms and all(f"{name}.weight" in state for name in names[:-1]):
        message = (
            "a DeepSDF without weight normalization, or IGR's network, which has the same names; for DeepSDF"
            ' give the import option {"family": "deepsdf"}, for IGR give the mesh'
        )
        raise FieldFormatError(message, reason="FAMILY_NOT_SUPPORTED")
    width = layers.input_width - 3
    if width < 0:
        raise tensor_error(f"lin0 has {layers.input_width} columns, expected 3 or more", "TENSOR_SHAPE")
    latent, whence = latent_code(checkpoint, source, overrides, width)
    whole = [i for i, extra in enumerate(layers.extra_columns) if extra == layers.input_width]
    seeing = [i for i, extra in enumerate(layers.extra_columns) if extra]
    require_extra_columns(layers, names, {i: layers.input_width if i in whole else 3 for i in seeing})
    why = (
        f"keys model_state_dict.lin*, {len(names)} layers",
        whence,
        "bounds [-1, 1]: the cube around the unit sphere, into which shapes are scaled",
    )
    folded = Network(at_code(layers, latent, (0, *whole)), tuple(seeing), norms)
    entries, form = shared_entries(overrides, UNIT_CUBE), Form("relu", output_tanh=1).said(overrides)
    converted = network_field(folded, form, FAMILY, entries, why)
    if overrides.output_tanh is not None:
        return converted
    forms = [replace(form, output_tanh=tanhs) for tanhs in (1, 2)]  # the second where ``use_tanh`` is set
    untold = tuple(form_variant(folded, one, FAMILY, entries, output_tanh=one.output_tanh) for one in forms)
    return replace(converted, untold=untold)


def _refuse_codes_alone(checkpoint: dict[Any, Any]) -> None:
    """Raise FieldFormatError (FIELD_NOT_RECOGNIZED) if the checkpoint is the half of a DeepSDF without the network."""
    if checkpoint.get("model_state_dict") is None and _CODES in checkpoint:
        message = "these are DeepSDF's latent codes without its network; give both in one file"
        raise FieldFormatError(message, reason="FIELD_NOT_RECOGNIZED")


def latent_code(
    checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription, width: int
) -> tuple[Float32Array, str]:
    """The shape's code (width,), and where it is from."""
    if overrides.latent is not None:
        if overrides.latent_index is not None or len(overrides.latent) != width:
            message = f"description.latent: expected {width} numbers, and no latent_index beside them"
            raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
        return np.array(overrides.latent, dtype=np.float32), "latent code from the import options"
    if width == 0:
        return np.zeros(0, dtype=np.float32), "no latent code: a network of one shape"
    if _CODES not in checkpoint:
        message = (
            f"DeepSDF's network without latent codes: put its latent_codes into the same file, or give "
            f"the {width} numbers"
            " of the shape as the import option latent"
        )
        raise FieldFormatError(message, reason="LATENT_MISSING")
    codes = _all_codes(checkpoint[_CODES], source, width)
    index = overrides.latent_index or 0
    if index >= len(codes):
        message = f"description.latent_index: {index}, but the file has {len(codes)} codes, counted from 0"
        raise FieldFormatError(message, reason="INVALID_DESCRIPTION")
    return codes[index], f"latent code {index} of {len(codes)} (counted from 0)"


def _all_codes(stored: object, source: TensorSource, width: int) -> Float32Array:
    """(N, width): an embedding's state, or, of older runs and of single reconstructions, a tensor (N, 1, width)."""
    value = stored if isinstance(stored, TensorRef) else lookup(strip_prefix(stored, ""), "weight")
    codes = source.array(_CODES, value)
    if codes.ndim == 3:
        require_shape(_CODES, codes, (None, 1, width))
        codes = codes[:, 0]
    require_shape(_CODES, codes, (None, width))
    return codes


def _norms(state: dict[str, Any], layers: Layers, source: TensorSource) -> dict[str, Float32Array]:
    """The layer normalizations that networks without weight normalization have behind some layers."""
    found = {}
    for i in range(len(layers.weights) - 1):
        if f"bn{i}.weight" in state:
            for part in ("weight", "bias"):
                name = f"bn{i}.{part}"
                found[f"norms.{i}.{part}"] = source.array(name, lookup(state, name))
                require_shape(name, found[f"norms.{i}.{part}"], (layers.weights[i].shape[0],))
    return found


def at_code(layers: Layers, latent: Float32Array, whole: tuple[int, ...]) -> Layers:
    """The layers that see [..., code, position], with the code's part moved into the bias."""
    weights, biases = list(layers.weights), list(layers.biases)
    for i in whole:
        start = weights[i].shape[1] - layers.input_width
        coded = weights[i][:, start : start + len(latent)].astype(np.float64)
        biases[i] = np.asarray(biases[i] + coded @ latent, dtype=np.float32)
        weights[i] = np.delete(weights[i], slice(start, start + len(latent)), axis=1)
    return Layers(tuple(weights), tuple(biases))


# DeepSDF as widespread later code writes it: blocks ``net.*0.0`` of a layer and ReLU, ``final_layer.0`` and one tanh.
#
# A narrower ``skip_layer.0``, behind which the network sees its input again, is in the file even where it is not used,
# and nothing says behind which block it is: if several places fit, it is asked.

BLOCKS = "deepsdf_blocks"
_USUAL = 3
"""How many blocks usually stand before the narrower layer."""


def convert_blocks(
    checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription
) -> ConvertedField | None:
    """The signed distance field of one shape, or None where the keys are not theirs.

    Raises FieldFormatError: LATENT_MISSING, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and what TensorSource
    raises.
    """
    if not ("final_layer.0.bias" in checkpoint and "net.0.0.bias" in checkpoint):
        return None
    state = {name: value for name, value in checkpoint.items() if isinstance(value, TensorRef)}
    require_family(overrides, BLOCKS)
    refuse_other_entries(overrides, BLOCKS, ("latent", "latent_index", "skip_layer", *FORM_ENTRIES))
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
        for place, layers, skips in _places(state, plain, source, overrides)
    ]
    if not places:
        raise FieldFormatError("description.skip_layer: there is no such layer", reason="INVALID_DESCRIPTION")
    why = (
        f"keys net.*.0 and final_layer.0, {len(blocks)} blocks",
        whence,
        "bounds [-1, 1]: the cube around the unit sphere, into which shapes are scaled",
    )
    converted = network_field(places[0][1], form, BLOCKS, entries, why)
    if len(places) == 1:
        return converted
    untold = tuple(form_variant(network, form, BLOCKS, entries, skip_layer=place) for place, network in places)
    return replace(converted, untold=untold)


def _places(
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

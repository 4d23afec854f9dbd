"""SIREN (Sitzmann et al. 2020) as its authors' code saves it: a bare state dictionary of a network of sines."""

from __future__ import annotations

from typing import Any

import numpy as np

from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import Layers, layer_names, read_layers, require_extra_columns, strip_prefix
from regnf_core.importing.families.shared import UNIT_CUBE, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "siren"
_OMEGA = 30.0
_PREFIX = "net.net."


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE and what TensorSource raises.
    """
    state = strip_prefix(checkpoint, _PREFIX)
    if not state:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY)
    names = [f"{name}.0" for name in layer_names(state, "")]
    layers = read_layers(state, names, source)
    if layers.input_width != 3:
        raise tensor_error(f"{_PREFIX}{names[0]} has {layers.input_width} columns, expected 3", "TENSOR_SHAPE")
    require_extra_columns(layers, names)
    description = {
        "kind": "mlp",
        **shared_entries(overrides, UNIT_CUBE),
        "activation": "sine",
        "source": {"family": FAMILY},
    }
    why = (
        f"keys {_PREFIX}*.0, {len(names)} layers",
        "bounds [-1, 1]: beyond the cube in which SIREN trains its sines repeat",
        f"sines of {_OMEGA:g} times the layers' results, as usual",
    )
    return ConvertedField(
        FAMILY, why, description, _with_frequency(layers).tensors(), sign_is_open=overrides.sign is None
    )


def _with_frequency(layers: Layers) -> Layers:
    """sin(30 (W h + b)) = sin((30 W) h + 30 b): the factor folded into all layers but the last."""
    last = len(layers.weights) - 1
    factors = [np.float32(_OMEGA if i < last else 1.0) for i in range(last + 1)]
    with np.errstate(over="ignore"):  # what is not finite is refused when it is written
        weights = tuple(np.asarray(f * w, dtype=np.float32) for f, w in zip(factors, layers.weights, strict=True))
    biases = tuple(np.asarray(f * b, dtype=np.float32) for f, b in zip(factors, layers.biases, strict=True))
    return Layers(weights, biases)

"""NeuS (Wang et al. 2021) as its authors' code saves it: one softplus network under ``sdf_network_fine``.

The network's own ``scale`` is not in the checkpoint: S(x) = f(scale x) / scale. It is taken as 1; for the two published
configurations that set 3, ``world_scale`` 1/3 and bounds of [-1, 1] say the same.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from regnf_core.importing.arrays import Float32Array, tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import Layers, layer_names, read_layers, require_extra_columns, strip_prefix
from regnf_core.importing.families.shared import UNIT_CUBE, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "neus"
_MAX_DEGREE = 24


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, TENSOR_MISSING, TENSOR_SHAPE and what TensorSource raises.
    """
    if "sdf_network_fine" not in checkpoint:
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY)
    state = strip_prefix(checkpoint["sdf_network_fine"], "")
    names = layer_names(state, "lin")
    layers = read_layers(state, names, source)
    degree, rest = divmod(layers.input_width - 3, 6)
    if rest or not 0 <= degree <= _MAX_DEGREE:
        raise tensor_error(f"lin0 has {layers.input_width} columns, expected 3 + 6 x frequencies", "TENSOR_SHAPE")
    skips = [i for i, extra in enumerate(layers.extra_columns) if extra]
    require_extra_columns(layers, names, dict.fromkeys(skips, layers.input_width))
    description = {
        "kind": "mlp",
        **shared_entries(overrides, UNIT_CUBE),
        "activation": "softplus",
        "positional_encoding": {"degree": degree},
        "input_at": skips,
        "source": {"family": FAMILY},
    }
    why = (
        f"keys sdf_network_fine.lin*, {len(names)} layers, {degree} frequencies",
        "bounds [-1, 1]: the unit sphere's cube, in which NeuS trains",
        "the network's scale is taken as 1, as usual (where it was 3 say world_scale 0.333333 and the bounds)",
    )
    return ConvertedField(FAMILY, why, description, _reordered(layers, degree, skips).tensors())


def _reordered(layers: Layers, degree: int, skips: list[int]) -> Layers:
    """The layers with the sines' columns in our order, and with the skip connections' 1 / sqrt 2 folded in.

    NeuS has frequency after frequency, for each the three sines, then the three cosines; we have all sines, axis by
    axis, then all cosines.
    """
    sines = [3 + 6 * k + axis for axis in range(3) for k in range(degree)]
    order = np.array([0, 1, 2, *sines, *(column + 3 for column in sines)])
    weights = list(layers.weights)
    for i in (0, *skips):
        before = weights[i].shape[1] - layers.input_width
        columns = np.concatenate((np.arange(before), before + order))
        weights[i] = _scaled(weights[i][:, columns], 1.0 if i == 0 else math.sqrt(0.5))
    return Layers(tuple(weights), layers.biases)


def _scaled(weight: Float32Array, factor: float) -> Float32Array:
    return np.asarray(weight * np.float32(factor), dtype=np.float32)

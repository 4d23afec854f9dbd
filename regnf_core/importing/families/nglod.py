"""NGLOD (Takikawa et al. 2021): volumes of features from coarse to fine, a small decoder for each level of detail."""

from __future__ import annotations

from typing import Any

import numpy as np

from regnf_core.errors import FieldFormatError
from regnf_core.importing.arrays import Float32Array, require_shape, tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import (
    UNIT_CUBE,
    layer_names,
    read_layers,
    refuse_other_entries,
    require_extra_columns,
    require_family,
    shared_entries,
    strip_prefix,
)
from regnf_core.importing.tensor_source import TensorSource, lookup
from regnf_core.importing.upload_description import UploadDescription

FAMILY = "nglod"


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The signed distance field of such a checkpoint at its finest level, or None where the keys are not theirs.

    Raises FieldFormatError: FAMILY_NOT_SUPPORTED, INVALID_DESCRIPTION, TENSOR_MISSING, TENSOR_SHAPE and what
    TensorSource raises.
    """
    state = strip_prefix(checkpoint, "")
    if "features.0.fm" not in state or not strip_prefix(state, "louts."):
        return None
    require_family(overrides, FAMILY)
    refuse_other_entries(overrides, FAMILY, ("level_mask",))
    levels = len(layer_names(state, "features.", minimum=1))
    if overrides.level_mask is not None and overrides.level_mask > levels:
        raise FieldFormatError(f"level_mask is above the {levels} levels", reason="INVALID_DESCRIPTION")
    used = overrides.level_mask or levels
    decoders = len(layer_names(state, "louts.", minimum=1))
    names = [f"louts.{min(used, decoders) - 1}.{part}" for part in (0, 2)]
    layers = read_layers(state, names, source)
    require_extra_columns(layers, names)
    tensors = {f"volumes.{i}": _volume(state, i, layers.input_width - 3, source) for i in range(used)}
    description = {"kind": "feature_volumes", **shared_entries(overrides, UNIT_CUBE), "source": {"family": FAMILY}}
    why = (
        f"keys features.*.fm and louts.*: {used} of {levels} levels of detail, decoded by {names[0][:-2]}",
        "bounds [-1, 1]: the cube of the volumes",
    )
    return ConvertedField(FAMILY, why, description, {**tensors, **layers.tensors()}, sign_is_open=True)


def _volume(state: dict[str, Any], level: int, features: int, source: TensorSource) -> Float32Array:
    """(N, N, N, C), first axis x, from the trainer's (1, C, N, N, N) with x last."""
    name = f"features.{level}.fm"
    volume = source.array(name, lookup(state, name))
    if volume.ndim != 5 or volume.shape[2] < 2:
        raise tensor_error(f"{name} has shape {volume.shape}, expected a volume of features", "TENSOR_SHAPE")
    require_shape(name, volume, (1, features, volume.shape[2], volume.shape[2], volume.shape[2]))
    return np.ascontiguousarray(volume[0].transpose(3, 2, 1, 0))

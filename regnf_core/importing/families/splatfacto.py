"""Gaussian splats as nerfstudio's splatfacto saves them in its checkpoints."""

from __future__ import annotations

from typing import Any

import numpy as np

from regnf_core.importing.arrays import tensor_error
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.layers import states
from regnf_core.importing.splats.gaussians import Floats, Splats, sigmoid
from regnf_core.importing.splats.packed import require_count
from regnf_core.importing.tensor_source import TensorSource
from regnf_core.importing.upload_description import UploadDescription

_STATES = ("_model.gauss_params.", "_model.")
"""Where nerfstudio's splatfacto keeps its tensors, the newer versions first."""


def convert(checkpoint: dict[Any, Any], source: TensorSource, overrides: UploadDescription) -> ConvertedField | None:
    """The field of a checkpoint of nerfstudio's splatfacto; None where the tensors are not its own."""
    for _, state in states(checkpoint):
        for prefix in _STATES:
            if f"{prefix}features_dc" in state and f"{prefix}means" in state:
                # It loads scipy, which other checkpoints do not need.
                from regnf_core.importing.families.gaussian_splats import convert_splats

                splats = _of_state(state, prefix, source)
                return convert_splats(splats, f"tensors {prefix}*", overrides, None, source.left)
    return None


def _of_state(state: dict[str, Any], prefix: str, source: TensorSource) -> Splats:
    def tensor(name: str, *shape: int) -> Floats:
        values = source.array(f"{prefix}{name}", state.get(f"{prefix}{name}"))
        if values.shape[1:] != shape:
            raise tensor_error(f"{prefix}{name} has shape {values.shape}, expected (any, {shape})", "TENSOR_SHAPE")
        return values

    means, harmonics = tensor("means", 3), tensor("features_dc", 3)[:, None]
    require_count(len(means))
    rest = state.get(f"{prefix}features_rest")
    if rest is not None:
        more = source.array(f"{prefix}features_rest", rest)
        if more.ndim == 3 and more.shape[1] in (3, 8, 15) and more.shape[2] == 3:
            harmonics = np.concatenate([harmonics, more], axis=1)
    opacities, turns = sigmoid(tensor("opacities", 1)[:, 0]), tensor("quats", 4)
    return Splats(means.astype(np.float64), tensor("scales", 3), turns, opacities, harmonics)

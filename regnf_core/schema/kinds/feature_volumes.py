"""The kind ``feature_volumes``: volumes of features from coarse to fine, their sum into a small network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from regnf_core.schema.description import FieldDescription
from regnf_core.schema.layers import check_layers, count_layers, layer_tensor_names
from regnf_core.schema.tensor_check import TensorSpec, require, require_names, require_shape

_MAX_VOLUMES = 16


@dataclass(frozen=True, kw_only=True)
class FeatureVolumesDescription(FieldDescription):
    """A field of the feature_volumes kind; see :class:`regnf_core.fields.feature_volumes.FeatureVolumesFunction`."""

    kind: Literal["feature_volumes"]

    def check_tensors(self, tensors: Mapping[str, TensorSpec]) -> None:
        """Raise FieldFormatError (FIELD_SHAPES_MISMATCH), naming the first tensor that is not as described."""
        volumes = count_volumes(tensors)
        require(1 <= volumes <= _MAX_VOLUMES, f"the field has {volumes} volumes, expected 1 to {_MAX_VOLUMES}")
        names = layer_tensor_names(count_layers(tensors))
        require_names(tensors, names | {f"volumes.{i}" for i in range(volumes)})
        features = tensors["volumes.0"].shape[-1] if tensors["volumes.0"].shape else 0
        for i in range(volumes):
            shape = tensors[f"volumes.{i}"].shape
            require(len(shape) == 4 and shape[0] >= 2, f"volumes.{i} has shape {shape}, expected a cube of features")
            require_shape(tensors, f"volumes.{i}", (shape[0], shape[0], shape[0], features))
        check_layers(tensors, 3 + features)


def count_volumes(names: Mapping[str, object]) -> int:
    """How many volumes there are."""
    return sum(name.startswith("volumes.") for name in names)

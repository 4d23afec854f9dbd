"""From a description and its tensors to a field that can be evaluated."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.observation import ObservedField, stored_observation
from regnf_core.fields.scaled import AdjustedField
from regnf_core.schema.kinds.kind import FieldDescription
from regnf_core.schema.kinds.observation_grid import OBSERVATION


def build_field(description: FieldDescription, tensors: Mapping[str, Tensor]) -> SdfField:
    """The field of ``description`` with its parameters in ``tensors`` (names as in the safe format), in float32.

    Tensors keep their device; they must have passed the description's ``check``.
    """
    field = description.build({name: tensor for name, tensor in tensors.items() if name != OBSERVATION})
    if description.observation is not None:
        field = ObservedField(field, stored_observation(description.observation, tensors[OBSERVATION]))
    if description.world_scale == 1.0 and description.sign == 1:
        return field
    return AdjustedField(field, description.world_scale, description.sign)

"""The function that a reading of a checkpoint stands for, ready to be evaluated."""

from __future__ import annotations

import warnings

import torch

from regnf_core.fields.build import build_field
from regnf_core.fields.observation import SdfField
from regnf_core.importing.families.converted import Reading
from regnf_core.schema.safe_format import parse_description, tensor_specs


def field_of(reading: Reading) -> SdfField:
    """Raises FieldFormatError where it is no field: a factor beyond what a field may have, for example."""
    description = parse_description(reading.description)
    description.check(tensor_specs(reading.tensors))
    with warnings.catch_warnings():
        # the map of the upload is only read
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        tensors = {name: torch.from_numpy(array) for name, array in reading.tensors.items()}
    return build_field(description, tensors)

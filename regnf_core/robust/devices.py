"""Which device the work is done on, and what may be asked of it.

Search and refinement run where the scene's field is. To read a number there, the CPU waits until all earlier work is
done; so nothing is read within an iteration. What one pose decides on the next is decided on the CPU, once a stage.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField


def working_device(field: SdfField) -> torch.device:
    """Where a registration in this scene computes: the field's device, or the CPU where that has no float64 (mps)."""
    return torch.device("cpu") if field.device.type == "mps" else field.device


def on_host(values: Tensor) -> bool:
    """Whether to read the values costs nothing."""
    return values.device.type == "cpu"

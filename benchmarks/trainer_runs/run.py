"""What a trainer's writer leaves: files, and the function they stand for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

ColorFunction = Callable[[Tensor, Tensor], Tensor]
"""Colors (N, 3) within [0, 1], R, G, B, at points (N, 3) along unit directions (N, 3)."""
Function = Callable[[Tensor], Tensor]
"""Distances (N,) at points (N, 3), both in double precision."""


@dataclass(frozen=True)
class WrittenRun:
    """A run's folder, its checkpoint, and the distances that it must give."""

    folder: Path
    checkpoint: Path
    settings: dict[str, Any]
    """What was drawn, for the report."""
    function: Function
    reach: float = 0.95
    """Points are compared within [-reach, reach]^3, in the field's own coordinates."""
    description: dict[str, Any] = field(default_factory=dict)
    """What no settings file says and a caller must."""
    color: ColorFunction | None = None

    def reference(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (N,) and gradients (N, 3), float64, by autograd."""
        at = points.double().clone().requires_grad_()
        distance = self.function(at)
        (gradient,) = torch.autograd.grad(distance.sum(), at)
        return distance.detach(), gradient


def normalized(weight: Tensor, factors: Tensor) -> dict[str, Tensor]:
    """Weight normalization's direction and length; ``factors`` (rows,): lengths of the stored directions."""
    value = weight.detach()
    return {"weight_g": value.norm(dim=1, keepdim=True), "weight_v": value * factors[:, None]}


def newer_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The names of torch's newer weight normalization."""
    return {
        key.replace("weight_g", "parametrizations.weight.original0").replace(
            "weight_v", "parametrizations.weight.original1"
        ): value
        for key, value in state.items()
    }

"""An object's declared symmetries, in the form of the BOP benchmark: rotations that leave its shape unchanged."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.geometry.sim3 import Sim3

_STEPS = 315  # BOP's: a point on the rim moves by at most 1 % of the diameter from one step to the next


@dataclass(frozen=True)
class ContinuousSymmetry:
    """Any turn about ``axis`` (3,) through ``offset`` (3,), object frame."""

    axis: Sequence[float]
    offset: Sequence[float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Symmetries:
    """Discrete: rigid 4x4 transforms of the object frame onto itself, identity left out. Continuous: whole axes."""

    discrete: Sequence[Sim3] = field(default_factory=list)
    continuous: Sequence[ContinuousSymmetry] = field(default_factory=list)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Symmetries:
        """From BOP's ``symmetries_discrete`` (16 numbers each, row-major) and ``symmetries_continuous`` (axis, offset).

        Lengths in object units. Raises InvalidInputError (INVALID_TRANSFORM, INVALID_SYMMETRY).
        """
        try:
            discrete = [
                Sim3.from_matrix(torch.tensor(numbers, dtype=torch.float64).reshape(4, 4))
                for numbers in values.get("symmetries_discrete", [])
            ]
            continuous = [
                ContinuousSymmetry(_three(entry["axis"]), _three(entry.get("offset", (0.0, 0.0, 0.0))))
                for entry in values.get("symmetries_continuous", [])
            ]
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise InvalidInputError(f"malformed symmetries: {error}", reason="INVALID_SYMMETRY") from error
        return cls(discrete, continuous)

    def transforms(self, steps: int = _STEPS) -> Sim3:
        """All symmetries as a batch (K,), the identity first: each discrete one with each step about each axis."""
        discrete = [Sim3.identity(), *self.discrete]
        turned = [Sim3.identity()]
        for symmetry in self.continuous:
            turned += [_turn(symmetry, 2 * math.pi * k / steps) for k in range(1, steps)]
        return Sim3.cat([turn @ fixed for fixed in discrete for turn in turned])


def _turn(symmetry: ContinuousSymmetry, angle: float) -> Sim3:
    axis = torch.tensor(list(symmetry.axis), dtype=torch.float64)
    offset: Tensor = torch.tensor(list(symmetry.offset), dtype=torch.float64)
    if not axis.norm() > 1e-9:
        raise InvalidInputError("a symmetry axis must not vanish", reason="INVALID_SYMMETRY")
    tangent = torch.cat([angle * axis / axis.norm(), torch.zeros(4, dtype=torch.float64)])
    return Sim3.from_translation(offset) @ Sim3.exp(tangent) @ Sim3.from_translation(-offset)


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

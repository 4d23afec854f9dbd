"""A field in another unit, or with the opposite sign."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.color import ColorFunction, color_in_unit, has_color, inverse_deviation_of
from regnf_core.fields.observation import Observation, observation_of
from regnf_core.geometry.sim3 import Sim3


class ScaledField:
    """S(x) = sign * scale * f(x / scale): ``scale`` is the length of one unit of f's coordinates, in the new unit.

    Coordinates and distances scale together, so the gradient's norm stays what it was.
    """

    color: ColorFunction
    """Only where the field has color."""

    def __init__(self, field: SdfField, scale: float = 1.0, sign: int = 1) -> None:
        self.field = field
        self.scale = scale
        self.sign = sign
        if has_color(field):
            self.color = color_in_unit(field, scale)

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU, new unit."""
        return self.field.bounds * self.scale

    @property
    def device(self) -> torch.device:
        """That of the field."""
        return self.field.device

    @property
    def observation(self) -> Observation | None:
        """What was observed, new unit; None where it is not known."""
        seen = observation_of(self.field)
        return None if seen is None else seen.seen_in(_scaling(1.0 / self.scale))

    @property
    def inverse_deviation(self) -> float | None:
        """NeuS's s, per new unit; None where the field has none."""
        inverse = inverse_deviation_of(self.field)
        return None if inverse is None else inverse / self.scale

    def to(self, device: torch.device | str) -> ScaledField:
        """The same field with its parameters on another device."""
        return ScaledField(self.field.to(device), self.scale, self.sign)

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3), new unit."""
        return self.field.signed_distance(points / self.scale) * (self.sign * self.scale)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3), new unit."""
        distance, gradient = self.field.signed_distance_and_gradient(points / self.scale)
        return distance * (self.sign * self.scale), gradient * self.sign


def _scaling(scale: float) -> Sim3:
    return Sim3(
        torch.tensor(scale, dtype=torch.float64), torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    )

"""A function that is defined within a box, extended to all of space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor

from regnf_core.fields.function_field import ColoredFunction, SdfFunction

F = TypeVar("F", bound=SdfFunction)


@dataclass(frozen=True)
class BoxExtension(Generic[F]):
    """g in the box; outside, g at the box's nearest point plus the distance to it. Continuous and finite everywhere.

    What lies outside is taken for free space: the true distance is at most so large, and at least the distance to the
    box where the box holds all of the surface.
    low, high: (3,), the box's corners · outward: -1 where g is negative in free space.
    """

    function: F
    low: Tensor
    high: Tensor
    outward: float = 1.0

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.function.device

    def to(self, device: torch.device | str) -> Self:
        """The same function with its parameters on another device."""
        return replace(self, function=self.function.to(device), low=self.low.to(device), high=self.high.to(device))

    def value(self, points: Tensor) -> Tensor:
        """g (N,) at points (N, 3), extended."""
        inside = self._nearest(points)
        value: Tensor = self.function.value(inside) + self.outward * (points - inside).norm(dim=-1)
        return value

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """g (N,) at points (N, 3), extended, and its gradient (N, 3)."""
        inside = self._nearest(points)
        value, gradient = self.function.value_and_gradient(inside)
        beyond = points - inside
        way = beyond.norm(dim=-1)
        away = beyond / way.clamp_min(torch.finfo(way.dtype).tiny).unsqueeze(-1)
        # Along an axis that leads out, the nearest point of the box stays where it is.
        gradient = torch.where(beyond == 0.0, gradient, 0.0)
        return value + self.outward * way, gradient + self.outward * away

    @property
    def has_color(self) -> bool:
        """Whether :meth:`color` may be asked."""
        return isinstance(self.function, ColoredFunction) and self.function.has_color

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) of g at points (N, 3); outside, that of the box's nearest point."""
        assert isinstance(self.function, ColoredFunction)
        return self.function.color(self._nearest(points), directions)

    def _nearest(self, points: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(points, self.low), self.high)

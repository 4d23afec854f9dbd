"""A field that counts its evaluations."""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.observation import Observation, observation_of


class CountingField:
    """A field that counts the points at which it is evaluated. A value with its gradient counts as one evaluation."""

    def __init__(self, field: SdfField) -> None:
        self.field = field
        self.evaluations = 0

    @property
    def bounds(self) -> Tensor:
        return self.field.bounds

    @property
    def device(self) -> torch.device:
        return self.field.device

    @property
    def observation(self) -> Observation | None:
        return observation_of(self.field)

    def to(self, device: torch.device | str) -> CountingField:
        moved = CountingField(self.field.to(device))
        moved.evaluations = self.evaluations
        return moved

    def signed_distance(self, points: Tensor) -> Tensor:
        self.evaluations += points.shape[0]
        return self.field.signed_distance(points)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        self.evaluations += points.shape[0]
        return self.field.signed_distance_and_gradient(points)

"""A field with smooth random errors, as a fit to images leaves them."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from regnf_core import SdfField


class BentField:
    """A field plus a random Gaussian function of zero mean: its surface is bent, its gradient follows.

    The function is a sum of ``waves`` random cosines (Rahimi and Recht 2007): standard deviation ``amplitude``,
    correlation exp(-d^2 / 2 ``length``^2) at a distance d, both in the field's units.
    """

    def __init__(self, field: SdfField, amplitude: float, length: float, seed: int, waves: int = 128) -> None:
        self.field = field
        generator = torch.Generator().manual_seed(seed)
        self._wave = torch.randn(3, waves, generator=generator) / length
        self._phase = 2 * math.pi * torch.rand(waves, generator=generator)
        self._height = amplitude * math.sqrt(2.0 / waves)

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: the field's own."""
        return self.field.bounds

    @property
    def device(self) -> torch.device:
        """That of the field."""
        return self.field.device

    def to(self, device: torch.device | str) -> BentField:
        """The same field and bend on another device."""
        moved = copy.copy(self)
        moved.field = self.field.to(device)
        moved._wave, moved._phase = self._wave.to(device), self._phase.to(device)
        return moved

    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3)."""
        return self.field.signed_distance(points) + self._height * self._angles(points).cos().sum(-1)

    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        value, gradient = self.field.signed_distance_and_gradient(points)
        angles = self._angles(points)
        return value + self._height * angles.cos().sum(-1), gradient - self._height * angles.sin() @ self._wave.T

    def _angles(self, points: Tensor) -> Tensor:
        return points.float() @ self._wave + self._phase

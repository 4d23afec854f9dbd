"""Sine and cosine features of a position, with their derivative."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PositionalEncoding:
    """sin and cos of every coordinate times base_frequency 2^k, k = 0 .. degree-1 (Mildenhall et al. 2020).

    Order: for each axis all frequencies, as sines; then the same block as cosines.
    """

    degree: int
    base_frequency: float = 1.0
    """1 as sdfstudio has it, 2 pi as nerfstudio has it."""

    @classmethod
    def with_two_pi(cls, degree: int, two_pi: bool) -> PositionalEncoding:
        """The encoding with base frequency 2 pi, or 1."""
        return cls(degree, 2.0 * math.pi if two_pi else 1.0)

    @property
    def width(self) -> int:
        """Number of features of an encoded point."""
        return 6 * self.degree

    def encode(self, points: Tensor) -> Tensor:
        """Features (N, 6 degree) at points (N, 3)."""
        angles = self._angles(points)
        return torch.cat((angles.sin(), angles.cos()), dim=-1)

    def pull_back(self, encoded: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (N, 3) with respect to the points, from ``encoded`` and the gradient by it (both (N, 6 degree))."""
        sines, cosines = encoded.chunk(2, dim=-1)
        by_sine, by_cosine = gradient.chunk(2, dim=-1)
        by_angle = by_sine * cosines - by_cosine * sines  # (N, 3 degree)
        by_axis = by_angle.reshape(*encoded.shape[:-1], 3, self.degree)
        return (by_axis * self._frequencies(encoded)).sum(dim=-1)

    def _angles(self, points: Tensor) -> Tensor:
        return (points.unsqueeze(-1) * self._frequencies(points)).flatten(start_dim=1)

    def _frequencies(self, like: Tensor) -> Tensor:
        return self.base_frequency * 2.0 ** torch.arange(self.degree, dtype=like.dtype, device=like.device)

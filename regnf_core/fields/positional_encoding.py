"""Sine and cosine features of a position, with their derivative."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.schema.positional_encoding import PositionalEncodingDescription

_A, _B, _C, _D = 0.8506508, 0.5257311, 0.809017, 0.309017
_ICOSAHEDRON = (
    *((_A, 0.0, _B), (_C, 0.5, _D), (_B, _A, 0.0), (1.0, 0.0, 0.0), (_C, 0.5, -_D), (_A, 0.0, -_B), (_D, _C, -0.5)),
    *((0.0, _B, -_A), (0.5, _D, -_C), (0.0, 1.0, 0.0), (-_B, _A, 0.0), (-_D, _C, -0.5), (0.0, _B, _A)),
    *((-_D, _C, 0.5), (_D, _C, 0.5), (0.5, _D, _C), (0.5, -_D, _C), (0.0, 0.0, 1.0), (-0.5, _D, _C)),
    *((-_C, 0.5, _D), (-_C, 0.5, -_D)),
)
"""Corners and middles of an icosahedron's edges, one of each opposite pair, in the order of mip-NeRF 360's matrix P."""


@dataclass(frozen=True)
class PositionalEncoding:
    """sin and cos of every coordinate times base_frequency 2^k, k = 0 .. degree-1 (Mildenhall et al. 2020).

    Order: for each axis all frequencies, as sines; then the same block as cosines. ``off_axis``: in place of the three
    coordinates the lengths along 21 directions, those of an icosahedron (Barron et al. 2022).
    """

    degree: int
    base_frequency: float = 1.0
    """1 as sdfstudio has it, 2 pi as nerfstudio has it."""
    off_axis: bool = False

    @classmethod
    def of(cls, description: PositionalEncodingDescription | None) -> PositionalEncoding | None:
        """The encoding of a description, or None where there is none in use."""
        if description is None or not description.used or not description.degree:
            return None
        frequency = 2.0 * math.pi if description.two_pi else 1.0
        return cls(description.degree, frequency * description.base_frequency, description.off_axis)

    @property
    def width(self) -> int:
        """Number of features of an encoded point."""
        return 2 * self.degree * (len(_ICOSAHEDRON) if self.off_axis else 3)

    def encode(self, points: Tensor) -> Tensor:
        """Features (N, 6 degree) at points (N, 3)."""
        angles = self._angles(points)
        return torch.cat((angles.sin(), angles.cos()), dim=-1)

    def encode_planes(self, points: Tensor) -> Tensor:
        """Features (6 degree, N) at points (3, N), in the order of :meth:`encode`, to the last digit the same."""
        lengths = self.directions(points) @ points if self.off_axis else points
        angles = (lengths.unsqueeze(1) * self.frequencies(points).unsqueeze(-1)).flatten(0, 1)
        return torch.cat((angles.sin(), angles.cos()))

    def pull_back(self, encoded: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (N, 3) with respect to the points, from ``encoded`` and the gradient by it (both (N, 6 degree))."""
        sines, cosines = encoded.chunk(2, dim=-1)
        by_sine, by_cosine = gradient.chunk(2, dim=-1)
        by_angle = by_sine * cosines - by_cosine * sines  # (N, 3 degree)
        by_axis = by_angle.reshape(*by_angle.shape[:-1], by_angle.shape[-1] // self.degree, self.degree)
        by_length = (by_axis * self.frequencies(encoded)).sum(dim=-1)
        return by_length @ self.directions(encoded) if self.off_axis else by_length

    def pull_back_planes(self, encoded: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (3, N) with respect to the points, from ``encoded`` and the gradient by it (both (6 degree, N))."""
        sines, cosines = encoded.chunk(2)
        frequencies = self.frequencies(encoded).tolist()
        by_sine, by_cosine = gradient.chunk(2)
        by_angle = torch.addcmul(by_sine * cosines, by_cosine, sines, value=-1.0)
        by_angle = by_angle.reshape(len(by_angle) // self.degree, self.degree, by_angle.shape[1])
        by_length: Tensor = by_angle[:, 0] * frequencies[0]
        for k in range(1, self.degree):
            by_length.add_(by_angle[:, k], alpha=frequencies[k])
        return self.directions(encoded).T @ by_length if self.off_axis else by_length

    def _angles(self, points: Tensor) -> Tensor:
        lengths = points @ self.directions(points).T if self.off_axis else points
        return (lengths.unsqueeze(-1) * self.frequencies(points)).flatten(start_dim=1)

    @staticmethod
    def directions(like: Tensor) -> Tensor:
        """Those of ``off_axis`` (21, 3), of the type and on the device of ``like``."""
        return torch.tensor(_ICOSAHEDRON, dtype=like.dtype, device=like.device)

    def frequencies(self, like: Tensor) -> Tensor:
        """What the coordinates are multiplied by (degree,), of the type and on the device of ``like``."""
        return self.base_frequency * 2.0 ** torch.arange(self.degree, dtype=like.dtype, device=like.device)

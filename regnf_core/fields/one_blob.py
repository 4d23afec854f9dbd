"""The one-blob encoding (Müller et al. 2019): how much of a bump about a coordinate lies in each bin of [0, 1]."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class OneBlob:
    """``bins`` numbers a coordinate, axis by axis. The bump is a quartic as wide as two bins, and [0, 1] is a ring.

    That is tiny-cuda-nn's: the kernel 15/16 (1 - u^2)^2 with u in bins.
    """

    bins: int

    def encode(self, unit_points: Tensor) -> Tensor:
        """Features (N, 3 bins) at points (N, 3) of the unit cube."""
        below = self._offsets(unit_points).clamp(-1.0, 1.0)
        share = 0.9375 * below * (1.0 - below.square() * (2.0 / 3.0 - 0.2 * below.square()))
        edges = share.sum(dim=-1)
        return (edges[..., 1:] - edges[..., :-1]).flatten(start_dim=1)

    def pull_back(self, unit_points: Tensor, gradient: Tensor) -> Tensor:
        """Gradient (N, 3) with respect to the points, from that by the features (N, 3 bins)."""
        below = self._offsets(unit_points).clamp(-1.0, 1.0)
        slopes = -0.9375 * self.bins * (1.0 - below.square()).square().sum(dim=-1)  # of the edges' shares
        by_bin = slopes[..., 1:] - slopes[..., :-1]
        return (by_bin * gradient.view_as(by_bin)).sum(dim=-1)

    def _offsets(self, unit_points: Tensor) -> Tensor:
        """From the points to the bins' edges, in bins, here and a turn of the ring away: (N, 3, bins + 1, 3)."""
        edges = torch.arange(self.bins + 1, dtype=unit_points.dtype, device=unit_points.device)
        turns = torch.tensor((-self.bins, 0.0, self.bins), dtype=unit_points.dtype, device=unit_points.device)
        return (edges - self.bins * unit_points.unsqueeze(-1)).unsqueeze(-1) + turns

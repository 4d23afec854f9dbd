"""Nearest neighbors among points, by a k-d tree on the CPU: exact, deterministic, fast enough for any device."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


class NearestNeighbors:
    """A search structure over points (M, 3)."""

    def __init__(self, points: Tensor) -> None:
        self.points = points.detach()
        self._tree = cKDTree(self.points.cpu().numpy())

    def query(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (N,) to the nearest point and its number (N,), for points (N, 3). Not differentiable."""
        distance, index = self._tree.query(points.detach().cpu().numpy())
        return torch.as_tensor(distance).to(points), torch.as_tensor(index, device=points.device)


def gaps(points: Tensor) -> Tensor:
    """(N,) distance from each point of a cloud (N, 3), N >= 1, to its third neighbor: how sparse it is there."""
    array = points.detach().cpu().numpy()
    distance, _ = cKDTree(array).query(array, k=min(4, len(array)))
    return torch.as_tensor(distance.reshape(len(array), -1)[:, -1]).to(points)

"""Neighbors, spacing and size of point sets: exact on any device."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import pdist
from torch import Tensor

_DISTANCES_AT_ONCE = 2**25
"""Of all points to some of those asked for, where there is no tree: bounds memory, at some 500 MB."""


class NearestNeighbors:
    """A search structure over points (M, 3): a k-d tree on the CPU, all distances elsewhere. Results are not
    differentiable."""

    def __init__(self, points: Tensor) -> None:
        self.points = points.detach()
        self._tree = cKDTree(self.points.numpy()) if points.device.type == "cpu" else None

    def query(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (N,) to the nearest point and its index (N,), for points (N, 3)."""
        distance, index = self.query_several(points, 1)
        return distance[:, 0], index[:, 0]

    def query_several(self, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Distances (N, K) to the nearest points, nearest first, and their indices (N, K); K = ``count``, at most M."""
        count = min(count, len(self.points))
        if self._tree is None:
            return nearest_of_all(self.points, points.detach(), count)
        distance, index = self._tree.query(points.detach().cpu().numpy(), k=range(1, count + 1))
        return torch.as_tensor(distance).to(points), torch.as_tensor(index, device=points.device)


def nearest_of_all(points: Tensor, queries: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances (N, K) from queries (N, 3) to the ``count`` nearest of points (M, 3), nearest first, and the indices
    (N, K): by all distances, in float64, in parts that bound memory. No part of it is read on the CPU."""
    few = max(1, _DISTANCES_AT_ONCE // len(points))
    found = []
    for part in torch.split(queries.double(), few):
        apart = (part[:, None] - points.double()).square_().sum(-1)
        found.append(apart.topk(count, dim=1, largest=False))
    squares, index = (torch.cat(parts) for parts in zip(*found, strict=True))
    return squares.sqrt().to(queries), index


def gaps(points: Tensor) -> Tensor:
    """(N,) distance from each point of a cloud (N, 3), N >= 1, to its third neighbor: how sparse the cloud is there."""
    distance, _ = NearestNeighbors(points).query_several(points.detach(), 4)  # the nearest is the point itself
    return distance[:, -1]


def diameter(points: Tensor) -> float:
    """The largest distance between any two of the points (N, 3), N >= 1; found among the convex hull's corners."""
    array = points.detach().double().cpu().numpy()
    if array.shape[0] < 2:
        return 0.0
    try:
        array = array[ConvexHull(array).vertices]
    except QhullError:  # flat or tiny clouds have no hull; their own extreme points are few enough below
        directions = np.random.default_rng(0).normal(size=(512, 3))
        heights = array @ directions.T
        array = array[np.unique(np.concatenate([heights.argmin(0), heights.argmax(0)]))]
    return float(pdist(array).max(initial=0.0))

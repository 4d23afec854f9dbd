"""The convex hull of an object's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Hull:
    """Half-spaces: normals (F, 3) pointing outward, and offsets (F,): within, normals @ x + offsets <= 0.

    Without any, nothing is within.
    """

    normals: Tensor
    offsets: Tensor

    @classmethod
    def of(cls, points: Tensor) -> Hull:
        """The hull of points (N, 3). Points in one plane have none."""
        try:
            equations = torch.from_numpy(np.unique(ConvexHull(points.double().cpu().numpy()).equations, axis=0)).float()
        except QhullError:
            equations = torch.zeros(0, 4)
        equations = equations.to(points.device)
        return cls(equations[:, :3], equations[:, 3])

    def to(self, device: torch.device | str) -> Hull:
        """The same hull on another device."""
        return Hull(self.normals.to(device), self.offsets.to(device))

    def contains(self, points: Tensor, margin: float) -> Tensor:
        """(...) bool: which points (..., 3) lie within, by at least ``margin`` from every face."""
        if len(self.normals) == 0:
            return torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
        within: Tensor = (points @ self.normals.mT + self.offsets).amax(-1) <= -margin
        return within

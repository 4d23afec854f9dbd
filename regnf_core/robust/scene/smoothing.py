"""How rough a sampled surface is, and the samples without that roughness: normals and heights averaged over neighbors.

A fit stopped early, or one to noisy images, has bumps as wide as its cells. What asks for planes and sides needs the
surface beneath them, and has to know how large they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from regnf_core.robust.residuals import Samples

_NEIGHBORS = 16
_ROUNDS = 2  # of averaging the normals: the first leaves those of the roughest neighbors
_SAME_SHEET = 0.3  # least cosine: the far side of a thin part has no say


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Points (N, 3) and unit normals (N, 3) averaged over neighbors on the same sheet.

    roughness: median standard deviation of the neighbors' heights, the points' unit · incoherence: 1 - median cosine
    between a sample's own normal and the averaged one; 0 for a plane, about 0.01 for accurate fits.
    """

    points: Tensor
    normals: Tensor
    roughness: float
    incoherence: float

    def __getitem__(self, index: Tensor) -> Smoothed:
        return Smoothed(self.points[index], self.normals[index], self.roughness, self.incoherence)


def smoothed(samples: Samples) -> Smoothed:
    """The samples' surface without its roughness."""
    points = samples.on_surface()
    count = min(_NEIGHBORS, len(samples))
    array = points.numpy()
    near = torch.from_numpy(cKDTree(array).query(array, k=count)[1].reshape(len(samples), count))
    normals = samples.normals
    for _ in range(_ROUNDS):
        neighbors = normals[near]
        alike = (neighbors * normals[:, None]).sum(-1, keepdim=True).clamp_min(0.0)
        normals = torch.nn.functional.normalize((alike * neighbors).sum(1), dim=-1)
    same = ((samples.normals[near] * normals[:, None]).sum(-1) > _SAME_SHEET).to(points)
    heights = ((points[near] - points[:, None]) * normals[:, None]).sum(-1)
    total = same.sum(1).clamp_min(1.0)
    mean = (heights * same).sum(1) / total
    spread = ((heights - mean[:, None]).square() * same).sum(1).div(total).sqrt()
    cosine = (samples.normals * normals).sum(-1)
    return Smoothed(
        points + mean[:, None] * normals, normals, float(spread.median()), 1.0 - float(cosine.median().clamp_max(1.0))
    )

"""How rough a sampled surface is, and the samples without that roughness: normals and heights averaged over neighbors.

A fit that was stopped early, or one to noisy images, has bumps as wide as its cells. Steps that look for planes need
the surface without the bumps, and their size.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.points import NearestNeighbors
from regnf_core.robust.constants import SCENE
from regnf_core.robust.samples import Samples


@dataclass(frozen=True, eq=False)
class SmoothedSurface:
    """Points (N, 3) and unit normals (N, 3) averaged over neighbors on the same sheet.

    roughness: median standard deviation of the neighbors' heights, the points' unit · normal_roughness: 1 - median
    cosine between a sample's own normal and the averaged one; 0 for a plane, about 0.01 for accurate fits.
    """

    points: Tensor
    normals: Tensor
    roughness: float
    normal_roughness: float

    def __getitem__(self, index: Tensor) -> SmoothedSurface:
        return SmoothedSurface(self.points[index], self.normals[index], self.roughness, self.normal_roughness)


def smooth(samples: Samples) -> SmoothedSurface:
    """The samples' surface without its roughness."""
    points = samples.on_surface()
    _, near = NearestNeighbors(points).query_several(points, SCENE.neighbors)
    normals = samples.normals
    for _ in range(SCENE.averaging_rounds):
        neighbors = normals[near]
        alike = (neighbors * normals[:, None]).sum(-1, keepdim=True).clamp_min(0.0)
        normals = torch.nn.functional.normalize((alike * neighbors).sum(1), dim=-1)
    same = ((samples.normals[near] * normals[:, None]).sum(-1) > SCENE.min_same_sheet_cosine).to(points)
    heights = ((points[near] - points[:, None]) * normals[:, None]).sum(-1)
    total = same.sum(1).clamp_min(1.0)
    mean = (heights * same).sum(1) / total
    spread = ((heights - mean[:, None]).square() * same).sum(1).div(total).sqrt()
    cosine = (samples.normals * normals).sum(-1)
    return SmoothedSurface(
        points + mean[:, None] * normals, normals, float(spread.median()), 1.0 - float(cosine.median().clamp_max(1.0))
    )

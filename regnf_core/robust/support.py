"""Floors, walls and table tops: planes that everything else in the region stands in front of.

A detection box holds part of what the object stands on or leans against. Such a plane is told from the object's own
faces without knowing which way is up: its normal faces all the rest, whereas behind an object's own face there is the
rest of the object.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.residuals import Samples

_CANDIDATES = 200
_THICKNESS = 0.012  # of the box's diagonal
_PARALLEL = 0.9  # least cosine between a plane's normal and those of its points
_LEAST_SHARE = 0.06  # of all samples: fewer are no plane worth removing
_MOST_BEHIND = 0.04  # of all samples: more behind it, and it is no support
_MOST_PLANES = 3


def support(samples: Samples, generator: torch.Generator) -> Tensor:
    """(N,) bool: which samples lie on a supporting plane, or behind it. Points in working units, box diagonal 1."""
    points, normals = samples.on_surface(), samples.normals
    on_support = torch.zeros(len(samples), dtype=torch.bool)
    for _ in range(_MOST_PLANES):
        rest = (~on_support).nonzero().squeeze(-1)
        if rest.numel() < 10:
            break
        found = _best_plane(points[rest], normals[rest], generator)
        if found is None:
            break
        on_support[rest[found]] = True
    return on_support


def _best_plane(points: Tensor, normals: Tensor, generator: torch.Generator) -> Tensor | None:
    """(N,) bool: points on and behind the most populated supporting plane; None when there is none."""
    picks = torch.randperm(points.shape[0], generator=generator)[:_CANDIDATES]
    n = normals[picks]  # (K, 3)
    heights = points @ n.T - (points[picks] * n).sum(-1)  # (N, K)
    facing = normals @ n.T
    on_plane = (heights.abs() <= _THICKNESS) & (facing >= _PARALLEL)
    behind = heights < -2 * _THICKNESS
    counts = on_plane.sum(0)
    # What faces the other way behind a plane is the far side of a floor or a wall, no argument against it.
    counts[(behind & (facing > -_PARALLEL)).float().mean(0) > _MOST_BEHIND] = 0
    best = int(counts.argmax())
    if counts[best] < _LEAST_SHARE * points.shape[0]:
        return None
    return (heights[:, best] <= 1.5 * _THICKNESS) & ((facing[:, best] >= 0.5) | behind[:, best])

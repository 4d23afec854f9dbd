"""A shape's signature: two histograms by which shapes are compared in a millisecond.

The distribution of distances between pairs of surface points (the D2 shape function, Osada et al. 2002) and that of
point pair features (distance and the three angles between the normals and the line that joins the points, Drost et al.
2010), both over the root mean square distance: the same for a shape however it is turned, moved or scaled.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.constants import SIGNATURE
from regnf_core.robust.samples import Samples, fixed_generator

_FEATURE_BINS = SIGNATURE.feature_distance_bins * SIGNATURE.angle_bins**3
SIGNATURE_LENGTH = SIGNATURE.distance_bins + _FEATURE_BINS


def signature(samples: Samples) -> Tensor:
    """(310,) square roots of the shares of point pairs in each bin: first the distances, then the pair features.

    Deterministic. Square roots make the squared Euclidean distance of two signatures twice the sum of two squared
    Hellinger distances.
    """
    points, normals = samples.on_surface(), samples.normals
    generator = fixed_generator()
    i, j = torch.randint(len(samples), (2, SIGNATURE.pairs), generator=generator)
    line = points[j] - points[i]
    length = line.norm(dim=-1)
    apart = length > 1e-6
    i, j, line, length = i[apart], j[apart], line[apart], length[apart]
    direction = line / length[:, None]
    relative = length / (length.square().mean().sqrt() * SIGNATURE.max_distance)
    at_start = (direction * normals[i]).sum(-1).abs()
    at_end = (direction * normals[j]).sum(-1).abs()
    between = ((normals[i] * normals[j]).sum(-1) + 1.0) / 2.0
    bins = _bin(relative, SIGNATURE.feature_distance_bins)
    for angle in (torch.minimum(at_start, at_end), torch.maximum(at_start, at_end), between):
        bins = bins * SIGNATURE.angle_bins + _bin(angle, SIGNATURE.angle_bins)
    distances = _bin(relative, SIGNATURE.distance_bins)
    return torch.cat([_shares(distances, SIGNATURE.distance_bins), _shares(bins, _FEATURE_BINS)])


def _bin(values: Tensor, count: int) -> Tensor:
    """Which of ``count`` equal parts of 0..1 each value lies in; what lies beyond counts with the last."""
    return (values * count).long().clamp(0, count - 1)


def _shares(bins: Tensor, count: int) -> Tensor:
    counts = torch.bincount(bins, minlength=count).float()
    return (counts / counts.sum().clamp_min(1.0)).sqrt()

"""A shape's signature: what a registration would never get wrong, told in a millisecond.

The distribution of distances between pairs of surface points (the D2 shape function, Osada et al. 2002) and that of
point pair features (distance and the three angles between the normals and the line that joins the points, Drost et al.
2010), both over the root mean square distance: the same for a shape however it is turned, moved or scaled.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.residuals import Samples

_PAIRS = 20_000
_SEED = 0
_LONGEST = 2.5  # root mean square distances
_DISTANCES = 40
_PAIR_DISTANCES, _ANGLES = 10, 3
SIGNATURE_LENGTH = _DISTANCES + _PAIR_DISTANCES * _ANGLES**3


def signature(samples: Samples) -> Tensor:
    """(310,) square roots of the shares of point pairs in each bin: first the distances, then the pair features.

    Deterministic. Square roots make the squared Euclidean distance of two signatures twice the sum of two squared
    Hellinger distances.
    """
    points, normals = samples.on_surface(), samples.normals
    generator = torch.Generator().manual_seed(_SEED)
    i, j = torch.randint(len(samples), (2, _PAIRS), generator=generator)
    line = points[j] - points[i]
    length = line.norm(dim=-1)
    apart = length > 1e-6
    i, j, line, length = i[apart], j[apart], line[apart], length[apart]
    way = line / length[:, None]
    relative = length / (length.square().mean().sqrt() * _LONGEST)
    at_start = (way * normals[i]).sum(-1).abs()
    at_end = (way * normals[j]).sum(-1).abs()
    between = ((normals[i] * normals[j]).sum(-1) + 1.0) / 2.0
    bins = _bin(relative, _PAIR_DISTANCES)
    for angle in (torch.minimum(at_start, at_end), torch.maximum(at_start, at_end), between):
        bins = bins * _ANGLES + _bin(angle, _ANGLES)
    return torch.cat([_shares(_bin(relative, _DISTANCES), _DISTANCES), _shares(bins, SIGNATURE_LENGTH - _DISTANCES)])


def _bin(values: Tensor, count: int) -> Tensor:
    """Which of ``count`` equal parts of 0..1 each value lies in; what lies beyond counts with the last."""
    return (values * count).long().clamp(0, count - 1)


def _shares(bins: Tensor, count: int) -> Tensor:
    counts = torch.bincount(bins, minlength=count).float()
    return (counts / counts.sum().clamp_min(1.0)).sqrt()

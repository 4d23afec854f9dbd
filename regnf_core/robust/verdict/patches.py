"""Disagreement that keeps to some places: errors of shape, as other objects have them, are alike in neighboring places.

Noise is not. So small patches of the object's surface are looked at: whether the residuals of a patch lie on one side,
and whether a whole patch, a part that the scene's object does not have, stands in space that was seen to be free.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.verdict.coverage import nearest_center, sum_by_patch


def disagreement(centers: Tensor, points: Tensor, values: Tensor, compared: Tensor, free: Tensor) -> dict[str, Tensor]:
    """Two features (H,) of H poses, by name, from what patches of the object's surface show.

    centers: (K, 3), of the patches, of which each has what is nearest to it · points: (M, 3) the object's samples, in
    the same frame · values: (H, M) their residuals, diameters, 0 at the surface · compared: (H, M) bool, the samples
    whose residuals count · free: (H, M) bool, those that stand in space that was seen to be free.

    ``coherence``: the share of the residuals' mean square that the patches' means make up, the correlation ratio;
    residuals of exact fields, below ``EVIDENCE.min_core``, show none · ``worst_patch_free``: the largest share of a
    patch that stands in free space.
    """
    mine = nearest_center(points, centers).expand(values.shape)
    count = len(centers)
    size = sum_by_patch(torch.ones_like(values), mine, count)
    of_free = sum_by_patch(free.to(values), mine, count)
    weight = compared.to(values)
    held = sum_by_patch(weight, mine, count)
    total = sum_by_patch(weight * values, mine, count)
    square = (weight * values.square()).sum(1)
    between = (total.square() / (held + EVIDENCE.prior_samples)).sum(1)
    floor = EVIDENCE.min_core**2 * weight.sum(1)
    return {
        "coherence": between / (square + floor).clamp_min(torch.finfo(values.dtype).tiny),
        "worst_patch_free": (of_free / (size + EVIDENCE.prior_samples)).amax(1),
    }

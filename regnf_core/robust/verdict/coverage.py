"""How much of the object the agreement covers: what is shown by patches of its surface, not by all samples together.

Another object, or the right one in a wrong place, agrees with the scene where the two are alike and not elsewhere. A
share of all samples does not tell that from errors that are spread over the whole object.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.constants import EVIDENCE


def coverage(
    centers: Tensor, object_points: Tensor, scene_points: Tensor, confirmed: Tensor, near: Tensor
) -> dict[str, Tensor]:
    """Shares (H,) of the object's patches, by name, for H poses.

    centers: (K, 3), of the patches, of which each has what is nearest to it · object_points: (M, 3) · scene_points:
    (H, N, 3), as the poses place them · all in the object's frame. confirmed: (H, M) bool, object samples that agree
    with the scene · near: (H, N) bool, scene samples near the object.

    ``confirmed_patches``: patches of which enough samples are confirmed · ``covered_patches``: patches with scene
    surface near them.
    """
    mine = _nearest(object_points, centers).expand(confirmed.shape)
    size = _count(torch.ones_like(confirmed), mine, len(centers))
    agreeing = _count(confirmed, mine, len(centers))
    seen = _count(near, _nearest(scene_points, centers), len(centers))
    return {
        "confirmed_patches": (agreeing >= EVIDENCE.min_confirmed_in_patch * size).double().mean(1),
        "covered_patches": (seen >= EVIDENCE.min_samples_in_patch).double().mean(1),
    }


def _nearest(points: Tensor, centers: Tensor) -> Tensor:
    """(...): the number of the center (K, 3) that each of the points (..., 3) is nearest to."""
    return torch.stack([(points - center).square().sum(-1) for center in centers]).argmin(0)


def _count(mask: Tensor, patch: Tensor, patches: int) -> Tensor:
    """(H, K): how many of the samples that ``mask`` (H, N) names belong to each patch; patch: (H, N), their numbers."""
    counts = torch.zeros(len(mask), patches, dtype=torch.long, device=mask.device)
    return counts.scatter_add_(1, patch, mask.long())

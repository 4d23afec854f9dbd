"""The refinement's robust loss: kernel widths, cost, normal equations, and the score that ranks poses.

The kernel itself is in regnf_core/robust/residuals.py, the numbers are in regnf_core/robust/constants.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.constants import EVIDENCE, REFINEMENT
from regnf_core.robust.residuals import Residuals, geman_mcclure_agreement, geman_mcclure_weight


def adaptive_width(r: Residuals, lowest: Tensor | float, widest: Tensor | float) -> Tensor:
    """(H, 1) kernel widths: ``lowest``, or up to ``widest`` where the spread of a pose's residuals asks for it. Object
    diameters; both are numbers, or (H, 1).

    With a fixed narrow kernel, fields with errors everywhere would be fitted at the few places without errors.
    """
    spread = torch.quantile(r.values.abs(), REFINEMENT.spread_quantile, dim=1, keepdim=True)
    return (REFINEMENT.spread_factor * spread).clamp(lowest, widest)  # type: ignore[arg-type]  # two numbers or tensors


def kernel_widths(r: Residuals, width: Tensor | float) -> Tensor | float:
    """Kernel widths of all residuals: narrower for object samples at places that were not observed."""
    if r.unobserved is None:
        return width
    return torch.where(r.unobserved, REFINEMENT.unobserved_width * width, width)


def offset_prior(partial: bool) -> float:
    """The weight of "no offset", where one direction's samples weigh 1. partial: not all of the scene was observed."""
    return REFINEMENT.offset_prior_partial if partial else REFINEMENT.offset_prior


def facing(r: Residuals) -> Tensor:
    """(H, N + M), 0..1: how well the normals agree: 1 where they are as close as an inlier's, 0 where they are more
    than 90 degrees apart. Small objects have rough normals: how far within 60 degrees tells little of a pose."""
    return (r.cosines / EVIDENCE.min_inlier_cosine).clamp(0.0, 1.0)


def _weighted(values: Tensor, r: Residuals, weight: Tensor | None) -> Tensor:
    """Values (H, N + M) of the samples, those of observed object samples times the weight (H, 1)."""
    if weight is None or r.unobserved is None:
        return values
    n = r.scene_count
    of_object = torch.where(r.unobserved[:, n:], values[:, n:], weight * values[:, n:])
    return torch.cat([values[:, :n], of_object], 1)


def observed_weight(r: Residuals) -> Tensor | None:
    """(H, 1): what an object sample that was observed weighs: as if all of the object had been. None: all of it was.

    Else the scene, all of whose samples were measured, has more to say the less of the object was seen, and what is
    near the object makes it too large.
    """
    if r.unobserved is None:
        return None
    _, observed = r.means((~r.unobserved).to(r.values))
    return 1.0 / observed[:, None].clamp_min(REFINEMENT.min_observed_share)


def robust_cost(r: Residuals, width: Tensor | float, normals: bool = True, weight: Tensor | None = None) -> Tensor:
    """(H,): mean over each direction of the loss, 0..1, the two directions averaged. weight: see
    :func:`observed_weight`; with it the loss may exceed 1.

    The loss is the Geman-McClure loss where the normals agree, larger where they do not, as that of
    :func:`disagreement`: surface that faces another way does not attract, however near it is. ``normals``: whether
    they count at all.
    A narrower kernel has the same curvature at zero, and so saturates at a lower loss.
    """
    widths = kernel_widths(r, width)
    agreement = geman_mcclure_agreement(r.values, widths)
    loss = (1.0 - (agreement * facing(r) if normals else agreement)) * (widths / width) ** 2
    of_scene, of_object = r.means(_weighted(loss, r, weight))
    cost = 0.5 * (of_scene + of_object)
    if r.offset is None:
        return cost
    prior = 0.5 * offset_prior(r.unobserved is not None)
    of_offset: Tensor = prior * (r.offset.to(cost)[:, None] / width).square().squeeze(-1)
    return cost + of_offset


def sample_weights(r: Residuals, width: Tensor | float, normals: bool = True, weight: Tensor | None = None) -> Tensor:
    """(H, N + M): the kernel's weights, times the normals' agreement, times ``weight`` (:func:`observed_weight`)."""
    weights = geman_mcclure_weight(r.values, kernel_widths(r, width))
    return _weighted(weights * facing(r) if normals else weights, r, weight)


def normal_equations(
    r: Residuals, width: Tensor | float, normals: bool = True, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """J^T W J (H, 7, 7) and J^T W r (H, 7) in float64, summed in the residuals' own precision.

    Each direction has the same total influence, but for ``weight`` (:func:`observed_weight`). An offset is the eighth
    unknown. The normals' agreement counts as a constant weight: how it changes with the pose is left out, and steps
    that raise the cost are undone.
    """
    weights = r.weighted(sample_weights(r, width, normals, weight))
    J = r.jacobian_with_offset().mT
    weighted = J * weights[:, None]
    H, b = (weighted @ J.mT).double(), (weighted @ r.values[..., None]).squeeze(-1).double()
    if r.offset is not None:
        H[:, 7, 7] += offset_prior(r.unobserved is not None)
        b[:, 7] += offset_prior(r.unobserved is not None) * r.offset
    return H, b


def disagreement(r: Residuals, width: float) -> Tensor:
    """(H,) scores in 0..1, smaller is better: Geman-McClure losses, larger where the normals disagree.

    Each direction counts half, however many samples it has. The loss of object samples at places that were not
    observed is limited.
    """
    loss = 1.0 - geman_mcclure_agreement(r.values, width) * facing(r)
    if r.unobserved is not None:
        loss = torch.where(r.unobserved, loss.clamp_max(REFINEMENT.unobserved_loss), loss)
    of_scene, of_object = r.means(loss)
    return 0.5 * (of_scene + of_object)

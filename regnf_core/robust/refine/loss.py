"""The refinement's robust loss: kernel widths, cost, normal equations, and the score that ranks poses.

The kernel itself is in regnf_core/robust/kernel.py, the numbers are in regnf_core/robust/constants/refinement.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.robust.constants import REFINEMENT
from regnf_core.robust.kernel import geman_mcclure_agreement, geman_mcclure_weight
from regnf_core.robust.residuals import Residuals


def adaptive_width(r: Residuals, lowest: float, widest: float) -> Tensor:
    """(H, 1) kernel widths: ``lowest``, or up to ``widest`` where the spread of a pose's residuals asks for it. Object
    diameters.

    With a fixed narrow kernel, fields with errors everywhere would be fitted at the few places without errors.
    """
    size = r.values.abs()
    if r.shares is None:
        spread = torch.quantile(size, REFINEMENT.spread_quantile, dim=1, keepdim=True)
    else:
        counting = size.masked_fill(r.shares == 0.0, torch.nan)
        spread = torch.nanquantile(counting, REFINEMENT.spread_quantile, dim=1, keepdim=True)
    return (REFINEMENT.spread_factor * spread).clamp(lowest, max(lowest, widest))


def kernel_widths(r: Residuals, width: Tensor | float) -> Tensor | float:
    """Kernel widths of all residuals: narrower for object samples at places that were not observed."""
    if r.unobserved is None:
        return width
    return torch.where(r.unobserved, REFINEMENT.unobserved_width * width, width)


def offset_prior(r: Residuals) -> float:
    """The weight of "no offset", where one direction's samples weigh 1."""
    return REFINEMENT.offset_prior if r.unobserved is None else REFINEMENT.offset_prior_partial


def facing(r: Residuals) -> Tensor:
    """(H, N + M), 0..1: how well the normals agree: their cosine, 0 where they are more than 90 degrees apart."""
    return r.cosines.clamp(0.0, 1.0)


def robust_cost(r: Residuals, width: Tensor | float, normals: bool = True) -> Tensor:
    """(H,): mean over each direction of the loss, 0..1, the two directions averaged.

    The loss is the Geman-McClure loss where the normals agree, larger where they do not, as that of
    :func:`disagreement`: surface that faces another way does not attract, however near it is. ``normals``: whether
    they count at all.
    A narrower kernel has the same curvature at zero, and so saturates at a lower loss.
    """
    widths = kernel_widths(r, width)
    agreement = geman_mcclure_agreement(r.values, widths)
    loss = (1.0 - (agreement * facing(r) if normals else agreement)) * (widths / width) ** 2
    of_scene, of_object = r.means(loss)
    cost = 0.5 * (of_scene + of_object)
    if r.offset is None:
        return cost
    prior: Tensor = 0.5 * offset_prior(r) * (r.offset.to(cost)[:, None] / width).square().squeeze(-1)
    return cost + prior


def normal_equations(r: Residuals, width: Tensor | float, normals: bool = True) -> tuple[Tensor, Tensor]:
    """J^T W J (H, 7, 7) and J^T W r (H, 7) in float64, summed in the residuals' own precision.

    Each direction has the same total influence. An offset is the eighth unknown. The normals' agreement counts as a
    constant weight: how it changes with the pose is left out, and steps that raise the cost are undone.
    """
    weights = geman_mcclure_weight(r.values, kernel_widths(r, width))
    weights = r.weighted(weights * facing(r) if normals else weights)
    J = r.jacobian_with_offset().mT
    weighted = J * weights[:, None]
    H, b = (weighted @ J.mT).double(), (weighted @ r.values[..., None]).squeeze(-1).double()
    if r.offset is not None:
        H[:, 7, 7] += offset_prior(r)
        b[:, 7] += offset_prior(r) * r.offset
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

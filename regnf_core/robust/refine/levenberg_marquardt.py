"""Levenberg-Marquardt on Sim(3) for many poses at once, with Geman-McClure weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.residuals import DistanceModel, Residuals, Samples, residuals

_UNSEEN_WIDTH = 0.3  # of the others' kernel
_DAMPING_START = 1e-2
_DAMPING_RANGE = (1e-7, 1e4)
_SPREAD_QUANTILE, _SPREAD_FACTOR = 0.3, 6.7
"""Three tenths of normal residuals are below 0.385 of their spread; 6.7 times that is 2.6 spreads. So low a quantile,
because up to two thirds of the samples may lie where the other field has nothing to say."""
_WIDEST = 0.04  # object diameters: what the spread may widen the kernel to
MOST_OFFSET = 0.04  # object diameters
OFFSET_PRIOR = 0.02
"""Of the weight of one direction's samples, in favor of no offset: round things may as well be larger as thicker."""
_LARGEST_STEP = 0.6  # of the rotation (radians), the shift (working units) and the log scale


@dataclass(frozen=True, eq=False)
class Refined:
    """Poses (H,) after the iterations, their robust costs (H,) and the residuals there."""

    T: Sim3
    costs: Tensor
    residuals: Residuals


def geman_mcclure_weights(r: Tensor, width: Tensor | float) -> Tensor:
    """Weights of r for the loss r^2 / (1 + r^2 / width^2) (up to a factor): 1 at zero, vanishing far out."""
    return (width**2 / (width**2 + r.square())).square()


def fitting_width(r: Residuals, least: float) -> Tensor:
    """(H, 1) kernel widths: ``least``, or as wide as the spread of each pose's residuals asks.

    Fields with errors everywhere would otherwise be fitted on the few places where the errors happen to vanish.
    """
    spread = torch.quantile(r.values.abs(), _SPREAD_QUANTILE, dim=1, keepdim=True)
    return (_SPREAD_FACTOR * spread).clamp(least, max(least, _WIDEST))


def kernel_widths(r: Residuals, width: Tensor | float) -> Tensor | float:
    """Kernel widths of all residuals: narrower for object samples that a partial scene does not show.

    The nearest surface to them is the border of the unseen, and would draw them there.
    """
    return width if r.unseen is None else torch.where(r.unseen, _UNSEEN_WIDTH * width, width)


def robust_cost(r: Residuals, width: Tensor | float) -> Tensor:
    """(H,): mean over each direction of the Geman-McClure loss scaled to 0..1, the two directions averaged.

    A narrower kernel bends the loss alike at zero, and so saturates lower.
    """
    widths = kernel_widths(r, width)
    loss = r.values.square() / (r.values.square() + widths**2) * (widths / width) ** 2
    cost = 0.5 * (loss[:, : r.scene_count].mean(1) + loss[:, r.scene_count :].mean(1))
    if r.offset is None:
        return cost
    prior: Tensor = 0.5 * OFFSET_PRIOR * (r.offset.to(cost)[:, None] / width).square().squeeze(-1)
    return cost + prior


def minimize(
    scene: DistanceModel,
    obj: DistanceModel,
    A: Samples,
    B: Samples,
    T: Sim3,
    widths: list[float],
    fix_scale: bool = False,
    adaptive: bool = False,
    on_iteration: Callable[[int, Sim3, Residuals, Tensor], None] | None = None,
    offset: Tensor | None = None,
    most_offset: float = MOST_OFFSET,
) -> Refined:
    """Minimize the robust cost of every pose in the batch T (H,), one iteration for each kernel width.

    widths: kernel widths, object units; falling widths anneal. With ``adaptive`` they are
    the least, see :func:`fitting_width`. A step that raises the cost is undone and damped more.
    offset: (H,) float64 to start from, of one surface outside the other; None: there is none, and none is looked for.
    most_offset: either way, object units.
    Each iteration asks each field once at each sample. Solves are in float64.
    """
    now = residuals(scene, obj, A, B, T, offset)
    damping = torch.full_like(T.scale, _DAMPING_START, dtype=torch.float64)
    width: Tensor | float = widths[-1]
    for iteration, least in enumerate(widths):
        width = fitting_width(now, least) if adaptive else least
        step = _step(now, width, damping, fix_scale, most_offset == 0.0)
        T_tried = T.perturb(step)
        shifted = None if now.offset is None else (now.offset + step[:, 7]).clamp(-most_offset, most_offset)
        tried = residuals(scene, obj, A, B, T_tried, shifted)
        better = robust_cost(tried, width) < robust_cost(now, width)
        T, now = Sim3.where(better, T_tried, T), _choose_residuals(better, tried, now)
        damping = torch.where(better, damping / 6.0, damping * 5.0).clamp(*_DAMPING_RANGE)
        if on_iteration is not None:
            on_iteration(iteration, T, now, robust_cost(now, width))
    return Refined(T, robust_cost(now, width), now)


def normal_equations(r: Residuals, width: Tensor | float) -> tuple[Tensor, Tensor]:
    """J^T W J (H, 7, 7) and J^T W r (H, 7) in float64; each direction has the same total influence.

    With an offset it is the eighth unknown.
    """
    n, m = r.scene_count, r.values.shape[1] - r.scene_count
    weights = geman_mcclure_weights(r.values, kernel_widths(r, width))
    weights = torch.cat([weights[:, :n] / n, weights[:, n:] / m], 1)
    J = with_offset(r)
    weighted = (J * weights[..., None]).mT.double()
    H, b = weighted @ J.double(), (weighted @ r.values.double()[..., None]).squeeze(-1)
    if r.offset is not None:
        H[:, 7, 7] += OFFSET_PRIOR
        b[:, 7] += OFFSET_PRIOR * r.offset
    return H, b


def with_offset(r: Residuals) -> Tensor:
    """The Jacobian (H, N + M, 7), or (H, N + M, 8) where there is an offset: with its column."""
    if r.offset is None:
        return r.jacobian
    column = torch.ones_like(r.jacobian[..., :1])
    column[:, : r.scene_count] = -1.0
    return torch.cat([r.jacobian, column], -1)


def _step(r: Residuals, width: Tensor | float, damping: Tensor, fix_scale: bool, fix_offset: bool) -> Tensor:
    H, b = normal_equations(r, width)
    diagonal = H.diagonal(dim1=-2, dim2=-1)
    extra = damping[:, None] * diagonal + 1e-9 + 1e-6 * diagonal.amax(-1, keepdim=True)
    fixed = torch.tensor([False] * 6 + [fix_scale, fix_offset])[: H.shape[-1]]
    extra = extra + 1e9 * fixed.double()
    step = -torch.linalg.solve(H + torch.diag_embed(extra), b)
    longest = step.abs().amax(-1, keepdim=True)
    short: Tensor = step * (_LARGEST_STEP / longest.clamp_min(_LARGEST_STEP))
    return short


def _choose_residuals(better: Tensor, first: Residuals, second: Residuals) -> Residuals:
    return Residuals(
        torch.where(better[:, None], first.values, second.values),
        torch.where(better[:, None, None], first.jacobian, second.jacobian),
        torch.where(better[:, None], first.cosines, second.cosines),
        first.scene_count,
        _choose_some(better[:, None], first.unseen, second.unseen),
        _choose_some(better, first.offset, second.offset),
    )


def _choose_some(better: Tensor, first: Tensor | None, second: Tensor | None) -> Tensor | None:
    return None if first is None or second is None else torch.where(better, first, second)

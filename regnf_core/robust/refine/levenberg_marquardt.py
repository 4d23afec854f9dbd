"""Levenberg-Marquardt on Sim(3) for many poses at once, with Geman-McClure weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.metrics import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native.steps import Pair
from regnf_core.robust.constants import EVIDENCE, REFINEMENT, SEARCH, Stage
from regnf_core.robust.refine.loss import (
    adaptive_width,
    disagreement,
    normal_equations,
    observed_weight,
    offset_prior,
    robust_cost,
)
from regnf_core.robust.refine.pose_candidates import Iterations, PoseCandidates
from regnf_core.robust.residuals import Residuals, SurfacePair, native_pair, residuals
from regnf_core.robust.search.bounds import ANY_SCALE, PoseBound, ScaleBound
from regnf_core.robust.working_frame import not_finite, on_host


@dataclass(frozen=True)
class Settings:
    """What may move, and how the kernel widths are meant.

    widest: the widths are lower limits, see :func:`regnf_core.robust.refine.loss.adaptive_width`; 0: they stay as they
    are · scale: what it may be, and is at the start · max_offset: of the surfaces, either way, object diameters;
    0: the offset stays as it is · normals: whether the loss counts them · keeps_scale: no pose's scale changes ·
    score_width: of the kernel of the scores · with_history: whether the iterations are kept.
    """

    widest: float = 0.0
    scale: ScaleBound = ANY_SCALE
    max_offset: float = REFINEMENT.max_offset
    normals: bool = True
    keeps_scale: bool = False
    score_width: float = EVIDENCE.score_width
    with_history: bool = False


@dataclass(frozen=True, eq=False)
class Minimum(Bundle):
    """Poses T (H,), their offsets (H,) or None, scores (H,), see :func:`regnf_core.robust.refine.loss.disagreement`,
    the |residuals| (H, N + M), and the iterations or None."""

    T: Sim3
    offset: Tensor | None
    scores: Tensor
    sizes: Tensor
    history: Iterations | None = None


_DEFAULTS = Settings()


def minimize(
    surfaces: SurfacePair,
    T: Sim3,
    widths: Sequence[float],
    settings: Settings = _DEFAULTS,
    offset: Tensor | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Minimum:
    """Minimize the robust cost of every pose of the batch T (H,), one iteration for each kernel width.

    widths: object diameters; falling widths anneal. A step that raises the cost is undone and damped more.
    A kernel has its width at the start of the minimization, and stays as wide in the scene: in object units, it is
    wider where the scale is larger.
    offset: (H,) float64 to start from, of one surface outside of the other; None: there is none.
    on_step: called after each iteration.
    Each iteration evaluates each field once at each sample. Linear systems are solved in float64.
    """
    pair = native_pair(surfaces, T)
    if pair is not None:
        return _compiled(pair, surfaces, T, widths, settings, offset, on_step)
    now = residuals(surfaces, T, offset)
    weight, start = observed_weight(now), T.scale
    damping = torch.full_like(T.scale, REFINEMENT.damping_start, dtype=torch.float64)
    history: list[Iterations] = []
    for lowest in widths:
        width = lowest * _rate(T, start, now)
        if settings.widest:
            width = adaptive_width(now, width, max(lowest, settings.widest) / lowest * width)
        step = _step(now, (width, weight), damping, T.scale, settings)
        T_tried = T.perturb(step[:, :7])
        most = settings.max_offset
        offset = None if now.offset is None else (now.offset + step[:, 7]).clamp(-most, most)
        tried = residuals(surfaces, T_tried, offset)
        # A kernel is as wide in the scene as before the step: in object units it grows with the pose's scale.
        tried_costs = robust_cost(tried, width * _rate(T_tried, T.scale, now), settings.normals, weight)
        costs = robust_cost(now, width, settings.normals, weight)
        better = tried_costs < costs  # False for a step that is not finite: it is undone as well
        T, now = Sim3.where(better, T_tried, T), Residuals.where(better, tried, now)
        less, more = damping / REFINEMENT.damping_decrease, damping * REFINEMENT.damping_increase
        damping = torch.where(better, less, more).clamp(*REFINEMENT.damping_range)
        if settings.with_history:
            now_costs, (of_scene, of_object) = torch.where(better, tried_costs, costs), now.means(now.values.abs())
            columns = now_costs[:, None], of_scene[:, None], of_object[:, None]
            history.append(Iterations(T[:, None], *columns, (lowest,), (_samples(surfaces),)))
        on_step()
    kept = reduce(Iterations.then, history) if history else None
    return Minimum(T, now.offset, disagreement(now, settings.score_width), now.values.abs(), kept)


def _compiled(
    pair: Pair, surfaces: SurfacePair, T: Sim3, widths: Sequence[float], settings: Settings, offset: Tensor | None,
    on_step: Callable[[], None],
) -> Minimum:  # fmt: skip
    """The same by compiled code."""
    low, high = REFINEMENT.damping_range
    named = (
        "damping_start", "damping_decrease", "damping_increase", "min_damping", "relative_damping", "fixed_damping",
        "max_step", "spread_quantile", "spread_factor", "unobserved_width", "min_observed_share", "unobserved_loss",
    )  # fmt: skip
    numbers = {name: getattr(REFINEMENT, name) for name in named} | {
        "damping_low": low, "damping_high": high, "offset_prior": offset_prior(pair.partial),
        "low": settings.scale.low, "high": settings.scale.high, "widest": settings.widest,
        "max_offset": settings.max_offset, "normals": settings.normals, "keeps_scale": settings.keeps_scale,
        "score_width": settings.score_width,
    }  # fmt: skip
    with_history = settings.with_history and len(widths) > 0
    poses = (T.scale, T.rotation, T.translation)
    found = pair.minimize(poses, offset, widths, numbers, on_step, with_history)
    if not found.finite:
        raise not_finite()
    history = None
    if with_history:
        of = found.history
        along = Sim3(of["scale"], of["rotation"], of["translation"])
        samples = (_samples(surfaces),) * len(widths)
        history = Iterations(along, of["costs"], of["of_scene"], of["of_object"], tuple(widths), samples)
    moved = Sim3(found.poses["scale"], found.poses["rotation"], found.poses["translation"])
    return Minimum(moved, found.poses.get("offset"), found.scores, found.sizes, history)


def _samples(surfaces: SurfacePair) -> int:
    return max(len(surfaces.scene_samples), len(surfaces.object_samples))


def _rate(T: Sim3, start: Tensor, r: Residuals) -> Tensor:
    """(H, 1): object units of the poses T (H,) for each one of poses with the scales ``start`` (H,), for lengths that
    are the same in the scene."""
    return (T.scale / start).to(r.values)[:, None]


def _step(
    r: Residuals, kernel: tuple[Tensor, Tensor | None], damping: Tensor, scale: Tensor, settings: Settings
) -> Tensor:
    """(H, 7) or, with an offset, (H, 8) steps of (omega, dt, log scale, offset). kernel: its width, and what observed
    object samples weigh."""
    H, b = normal_equations(r, kernel[0], settings.normals, kernel[1])
    diagonal = H.diagonal(dim1=-2, dim2=-1)
    largest = diagonal.amax(-1, keepdim=True)
    extra = damping[:, None] * diagonal + REFINEMENT.min_damping + REFINEMENT.relative_damping * largest
    if settings.max_offset == 0.0:
        extra[:, 7:] += REFINEMENT.fixed_damping  # the offset stays where it is
    step = _solved(H + torch.diag_embed(extra), -b, scale.double(), settings)
    longest = step.abs().amax(-1, keepdim=True)
    limited: Tensor = step * (REFINEMENT.max_step / longest.clamp_min(REFINEMENT.max_step))
    return limited


def _solved(A: Tensor, b: Tensor, scale: Tensor, settings: Settings) -> Tensor:
    """(H, K) x with A x = b; where the scale (H,) would leave its bound, it goes up to it and the others follow."""
    step = _solution(A, b)
    if settings.scale.is_open and not settings.keeps_scale:
        return step
    growth = torch.zeros_like(scale) if settings.keeps_scale else settings.scale.limited_growth(scale, step[:, 6])
    held, known = A.clone(), b.clone()
    held[:, 6], held[:, 6, 6], known[:, 6] = 0.0, 1.0, growth
    return torch.where((growth != step[:, 6])[:, None], _solution(held, known), step)


def _solution(A: Tensor, b: Tensor) -> Tensor:
    """(H, K) x with A x = b. Whether A is singular is asked on the CPU alone: elsewhere the answer takes a copy, and a
    step that is not finite is undone like any that raises the cost."""
    x: Tensor = torch.linalg.solve_ex(A, b, check_errors=on_host(A)).result
    return x


# The coarse-to-fine loop of every search and refinement: in each stage more samples, narrower kernels, fewer poses.


@dataclass(frozen=True, eq=False)
class RefinementContext:
    """What all stages share.

    extremal_points: (E, 3) of the object, by which two poses are compared · generator: draws each stage's samples ·
    scale: what it may be, and is at the start · max_offset: of the surfaces, object diameters · on_step: called once an
    iteration · bound: what is known of the poses: those that it does not admit end, unless it admits none, and its
    penalty is added to their scores · with_history: whether the iterations are kept.
    """

    extremal_points: Tensor
    generator: torch.Generator
    scale: ScaleBound = ANY_SCALE
    max_offset: float = REFINEMENT.max_offset
    on_step: Callable[[], None] = lambda: None
    bound: PoseBound | None = None
    with_history: bool = False

    def settings(self, stage: Stage) -> Settings:
        """Those of a stage."""
        moving = (self.scale, self.max_offset, stage.normals, stage.keeps_scale)
        return Settings(stage.widest, *moving, stage.score_width, self.with_history)


def coarse_to_fine(
    surfaces: SurfacePair, candidates: PoseCandidates, stages: Sequence[Stage], context: RefinementContext
) -> PoseCandidates:
    """The candidates that are left after all stages, best first."""
    for stage in stages:
        if stage.copies:
            candidates = candidates.with_copies(stage.copies, stage.spread, context.generator)
            candidates = replace(candidates, T=context.scale.limited_poses(candidates.T))
        few = surfaces.subsample(stage.points, context.generator)
        settings = context.settings(stage)
        parts = []
        for some in candidates.split(SEARCH.batch):
            found = minimize(few, some.T, stage.widths, settings, some.offsets, context.on_step)
            history = some.history
            if found.history is not None:
                history = found.history if history is None else history.then(found.history)
            parts.append(PoseCandidates(found.T, found.scores, found.offset, history))
        candidates = parts[0] if len(parts) == 1 else PoseCandidates.cat(parts)
        admitted = None
        if context.bound is not None:
            admitted, penalty = context.bound.judged(candidates.T)
            candidates = replace(candidates, scores=candidates.scores + penalty)
        left = survivors(candidates, admitted, stage, context.extremal_points)
        candidates = candidates[left.to(candidates.scores.device)]
        surfaces.require_finite()
    return candidates


def survivors(candidates: PoseCandidates, admitted: Tensor | None, stage: Stage, extremal_points: Tensor) -> Tensor:
    """Numbers of the candidates that go on, best first, on the CPU, where they are chosen: one copy a stage.

    admitted: (H,) bool, which may go on; where it is None or none is, all may.
    """
    scores, T = candidates.scores.cpu(), candidates.T.on("cpu")
    allowed = np.ones(len(scores), bool) if admitted is None else admitted.cpu().numpy()
    may = torch.from_numpy(np.flatnonzero(allowed if allowed.any() else ~allowed))
    scores = scores[may]
    if stage.min_distance == 0.0:
        return may[scores.argsort()[: stage.keep]]
    kept = distinct(T[may], scores, extremal_points, stage.min_distance, stage.keep)
    near = scores[kept].numpy()
    return may[kept[: np.count_nonzero(near <= near[0] + stage.margin)]]  # they are in order

"""The coarse-to-fine loop of every search and refinement: in each stage more samples, narrower kernels, fewer poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import REFINEMENT, SEARCH
from regnf_core.robust.refine.levenberg_marquardt import Iteration, Settings, minimize
from regnf_core.robust.refine.loss import disagreement
from regnf_core.robust.refine.pose_candidates import PoseCandidates, Step
from regnf_core.robust.residuals import SurfacePair, residuals
from regnf_core.robust.search.scale_bound import ANY_SCALE, ScaleBound
from regnf_core.robust.stage import Stage


@dataclass(frozen=True, eq=False)
class RefinementContext:
    """What all stages share.

    extremal_points: (E, 3) of the object, by which two poses are compared · generator: draws each stage's samples ·
    scale: what it may be, and is at the start · max_offset: of the surfaces, object diameters · on_step: called once an
    iteration · admits: which poses (H,) may go on, (H,) bool; where it admits none, all may · penalty: (H,) what is
    added to the scores of poses (H,).
    """

    extremal_points: Tensor
    generator: torch.Generator
    scale: ScaleBound = ANY_SCALE
    max_offset: float = REFINEMENT.max_offset
    on_step: Callable[[], None] = lambda: None
    admits: Callable[[Sim3], Tensor] = lambda T: torch.ones_like(T.scale, dtype=torch.bool)
    penalty: Callable[[Sim3], Tensor] = lambda T: torch.zeros_like(T.scale)


def coarse_to_fine(
    surfaces: SurfacePair, candidates: PoseCandidates, stages: Sequence[Stage], context: RefinementContext
) -> PoseCandidates:
    """The candidates that are left after all stages, best first."""
    for stage in stages:
        if stage.copies:
            candidates = candidates.with_copies(stage.copies, stage.spread, context.generator)
            candidates = replace(candidates, T=context.scale.limited_poses(candidates.T))
        few = surfaces.subsample(stage.points, context.generator)
        numbers = torch.arange(len(candidates), device=candidates.scores.device)
        parts = [_refine(few, candidates[part], stage, context) for part in torch.split(numbers, SEARCH.batch)]
        candidates = _admitted(PoseCandidates.cat(parts), context)
        candidates = candidates[_best(candidates, stage, context.extremal_points)]
        surfaces.require_finite()
    return candidates


def _admitted(candidates: PoseCandidates, context: RefinementContext) -> PoseCandidates:
    admitted = context.admits(candidates.T)
    return candidates[admitted.nonzero().squeeze(-1)] if bool(admitted.any()) else candidates


def _refine(few: SurfacePair, candidates: PoseCandidates, stage: Stage, context: RefinementContext) -> PoseCandidates:
    """All candidates after one stage's iterations, with their scores there."""
    if not stage.widths:
        r = residuals(few, candidates.T, candidates.offsets)
        scores = disagreement(r, stage.score_width) + context.penalty(candidates.T)
        return PoseCandidates(candidates.T, scores, candidates.offsets, candidates.history)
    history = list(candidates.history)

    def record(done: Iteration) -> None:
        size, n = done.residuals.values.abs(), done.residuals.scene_count
        history.append(Step(done.T, done.costs, size[:, :n].mean(1), size[:, n:].mean(1), done.width, stage.points))
        context.on_step()

    settings = Settings(stage.widest, context.scale, context.max_offset)
    refined = minimize(few, candidates.T, stage.widths, settings, candidates.offsets, record)
    scores = disagreement(refined.residuals, stage.score_width) + context.penalty(refined.T)
    return PoseCandidates(refined.T, scores, refined.residuals.offset, tuple(history))


def _best(candidates: PoseCandidates, stage: Stage, extremal_points: Tensor) -> Tensor:
    """Numbers of the candidates that go on, best first, on their device. Chosen on the CPU: one copy a stage."""
    scores, device = candidates.scores.cpu(), candidates.scores.device
    if stage.min_distance == 0.0:
        return scores.argsort()[: stage.keep].to(device)
    kept = distinct(candidates.T, scores, extremal_points, stage.min_distance, stage.keep)
    return kept[scores[kept] <= scores[kept[0]] + stage.margin].to(device)

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
from regnf_core.robust.search.scale_bound import ANY_SCALE, ScaleBound, ScaleBounds
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


@dataclass(frozen=True, eq=False)
class Descent:
    """A pair of surfaces, its pose candidates, and the context: what goes through the stages."""

    surfaces: SurfacePair
    candidates: PoseCandidates
    context: RefinementContext

    def prepared(self, stage: Stage) -> Descent:
        """With the copies that the stage asks for, and its samples of the surfaces."""
        candidates, context = self.candidates, self.context
        if stage.copies:
            candidates = candidates.with_copies(stage.copies, stage.spread, context.generator)
            candidates = replace(candidates, T=context.scale.limited_poses(candidates.T))
        return Descent(self.surfaces.subsample(stage.points, context.generator), candidates, context)


def coarse_to_fine(
    surfaces: SurfacePair, candidates: PoseCandidates, stages: Sequence[Stage], context: RefinementContext
) -> PoseCandidates:
    """The candidates that are left after all stages, best first."""
    for stage in stages:
        ready = Descent(surfaces, candidates, context).prepared(stage)
        numbers = torch.arange(len(ready.candidates), device=candidates.scores.device)
        parts = []
        for part in torch.split(numbers, SEARCH.batch):
            some = ready.candidates[part]
            scale = ScaleBounds.same(some.T) if stage.keeps_scale else context.scale
            settings = Settings(stage.widest, scale, context.max_offset, stage.normals)
            done = refined(ready.surfaces, some, stage, settings, context.on_step)
            parts.append(replace(done, scores=done.scores + context.penalty(done.T)))
        candidates = PoseCandidates.cat(parts)
        left = survivors(candidates, context.admits(candidates.T), stage, context.extremal_points)
        candidates = candidates[left.to(candidates.scores.device)]
        surfaces.require_finite()
    return candidates


def refined(
    few: SurfacePair, candidates: PoseCandidates, stage: Stage, settings: Settings, on_step: Callable[[], None]
) -> PoseCandidates:
    """All candidates after one stage's iterations, with their scores there."""
    if not stage.widths:
        r = residuals(few, candidates.T, candidates.offsets)
        return replace(candidates, scores=disagreement(r, stage.score_width))
    history = list(candidates.history)

    def record(done: Iteration) -> None:
        of_scene, of_object = done.residuals.means(done.residuals.values.abs())
        history.append(Step(done.T, done.costs, of_scene, of_object, done.width, stage.points))
        on_step()

    found = minimize(few, candidates.T, stage.widths, settings, candidates.offsets, record)
    scores = disagreement(found.residuals, stage.score_width)
    return PoseCandidates(found.T, scores, found.residuals.offset, tuple(history))


def survivors(candidates: PoseCandidates, admitted: Tensor, stage: Stage, extremal_points: Tensor) -> Tensor:
    """Numbers of the candidates that go on, best first, on the CPU, where they are chosen: one copy a stage.

    admitted: (H,) bool, which may go on; where it is none, all may.
    """
    admitted = admitted.cpu()
    may = (admitted if bool(admitted.any()) else ~admitted).nonzero().squeeze(-1)
    scores = candidates.scores.cpu()[may]
    if stage.min_distance == 0.0:
        return may[scores.argsort()[: stage.keep]]
    kept = distinct(candidates.T.on("cpu")[may], scores, extremal_points, stage.min_distance, stage.keep)
    return may[kept[scores[kept] <= scores[kept[0]] + stage.margin]]

"""The few candidates that can win, refined on the fields themselves: coarse to fine, fewer and fewer of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.refine.levenberg_marquardt import minimize
from regnf_core.robust.residuals import DistanceModel, Residuals, Samples
from regnf_core.robust.samples import some
from regnf_core.robust.search.search import disagreement

_APART = 0.03  # object diameters: candidates closer together have met in one minimum


@dataclass(frozen=True)
class Step:
    """One iteration of all poses: T (H,), robust costs (H,), mean |r| each way (H,), (H,), object diameters."""

    T: Sim3
    costs: Tensor
    residual_scene: Tensor
    residual_object: Tensor
    width: float
    samples: int


@dataclass(frozen=True)
class Stage:
    """Refine with kernel ``widths`` on ``points`` a side; keep at most ``keep``, within ``margin`` of the best."""

    points: int
    widths: tuple[float, ...]
    score_width: float
    keep: int
    margin: float


STAGES = (
    Stage(points=96, widths=(0.10, 0.07, 0.05, 0.035, 0.025, 0.02), score_width=0.02, keep=5, margin=0.15),
    Stage(points=300, widths=(0.02, 0.015, 0.01, 0.01), score_width=0.015, keep=3, margin=0.10),
)
LAST = Stage(points=700, widths=(0.01, 0.01, 0.008, 0.008, 0.008), score_width=0.015, keep=8, margin=1.0)
"""Widths in object diameters. LAST also refines the winner's twins."""


@dataclass
class Trail:
    """The steps taken so far by the poses that are still in the race."""

    steps: list[Step] = field(default_factory=list)

    def keep(self, index: Tensor) -> Trail:
        """The trail of the poses that ``index`` names."""
        return Trail(
            [
                Step(
                    s.T[index],
                    s.costs[index],
                    s.residual_scene[index],
                    s.residual_object[index],
                    s.width,
                    s.samples,
                )
                for s in self.steps
            ]
        )


@dataclass(frozen=True, eq=False)
class Finalists:
    """Poses (H,), best first, their scores (H,), their residuals on the stage's samples, and how they came there.

    offsets: (H,), see :class:`regnf_core.robust.residuals.Residuals`.
    """

    T: Sim3
    scores: Tensor
    residuals: Residuals
    trail: Trail
    offsets: Tensor


def run_stage(
    scene: DistanceModel,
    obj: DistanceModel,
    A: Samples,
    B: Samples,
    T: Sim3,
    stage: Stage,
    extremes: Tensor,
    generator: torch.Generator,
    trail: Trail,
    on_step: Callable[[], None],
    offsets: Tensor,
    most_offset: float,
) -> Finalists:
    """Refine every pose of the batch on the stage's share of the samples, and keep the best distinct ones."""
    few_A, few_B = some(A, stage.points, generator), some(B, stage.points, generator)
    trail = Trail(list(trail.steps))

    def record(iteration: int, T_now: Sim3, r: Residuals, costs: Tensor) -> None:
        size = r.values.abs()
        n = r.scene_count
        trail.steps.append(
            Step(T_now, costs, size[:, :n].mean(1), size[:, n:].mean(1), stage.widths[iteration], stage.points)
        )
        on_step()

    refined = minimize(
        scene,
        obj,
        few_A,
        few_B,
        T,
        list(stage.widths),
        adaptive=True,
        on_iteration=record,
        offset=offsets,
        most_offset=most_offset,
    )
    scores = disagreement(refined.residuals, stage.score_width)
    kept = distinct(refined.T, scores, extremes, _APART, stage.keep)
    kept = kept[scores[kept] <= scores[kept[0]] + stage.margin]
    r = refined.residuals.of(kept)
    assert r.offset is not None
    return Finalists(refined.T[kept], scores[kept], r, trail.keep(kept), r.offset)

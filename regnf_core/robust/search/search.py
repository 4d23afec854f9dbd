"""From thousands of seeds to a dozen candidates, on the samples alone: successive halving, no field evaluations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.refine.levenberg_marquardt import minimize
from regnf_core.robust.residuals import DistanceModel, Residuals, Samples, residuals
from regnf_core.robust.samples import some

_UNSEEN_LOSS = 0.6  # of object samples that a partial scene does not show
_CHUNK = 512  # poses at once: bounds memory, and the working set stays in the cache


@dataclass(frozen=True)
class Round:
    """One round: refine what came in, with kernel ``widths`` on ``points`` a side, then keep the ``keep`` best."""

    points: int
    widths: tuple[float, ...]
    score_width: float
    keep: int
    apart: float


ROUNDS = (
    Round(points=48, widths=(), score_width=0.10, keep=500, apart=0.0),
    Round(points=64, widths=(0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=120, apart=0.05),
    Round(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=40, apart=0.05),
    Round(points=256, widths=(0.04, 0.03, 0.03, 0.03), score_width=0.03, keep=10, apart=0.05),
)
"""Widths and ``apart`` in object diameters. The first round only ranks the seeds."""


def disagreement(r: Residuals, width: float) -> Tensor:
    """(H,) scores in 0..1, smaller is better: Geman-McClure losses, made worse where the normals disagree.

    Each direction counts half, however many samples it has. Object samples that a partial scene does not
    show count in between.
    """
    agreement = width**2 / (r.values.square() + width**2) * r.cosines.clamp(0.0, 1.0)
    loss = 1.0 - agreement
    if r.unseen is not None:
        loss = torch.where(r.unseen, loss.clamp_max(_UNSEEN_LOSS), loss)
    return 0.5 * (loss[:, : r.scene_count].mean(1) + loss[:, r.scene_count :].mean(1))


def search(
    scene: DistanceModel,
    obj: DistanceModel,
    A: Samples,
    B: Samples,
    T: Sim3,
    extremes: Tensor,
    generator: torch.Generator,
    rounds: tuple[Round, ...] = ROUNDS,
) -> tuple[Sim3, Tensor]:
    """The candidates left after all rounds and their scores, best first.

    extremes: (E, 3) outermost points of the object, by which poses are told apart.
    """
    scores = torch.zeros_like(T.scale)
    for one in rounds:
        few_A, few_B = some(A, one.points, generator), some(B, one.points, generator)
        parts = [_refine(scene, obj, few_A, few_B, part, one) for part in _chunks(T)]
        T = Sim3.cat([p[0] for p in parts])
        scores = torch.cat([p[1] for p in parts])
        kept = distinct(T, scores, extremes, one.apart, one.keep) if one.widths else scores.argsort()[: one.keep]
        T, scores = T[kept], scores[kept]
    return T, scores


def _refine(
    scene: DistanceModel, obj: DistanceModel, A: Samples, B: Samples, T: Sim3, one: Round
) -> tuple[Sim3, Tensor]:
    if one.widths:
        refined = minimize(scene, obj, A, B, T, list(one.widths))
        return refined.T, disagreement(refined.residuals, one.score_width)
    return T, disagreement(residuals(scene, obj, A, B, T), one.score_width)


def _chunks(T: Sim3) -> list[Sim3]:
    return [T[part] for part in torch.split(torch.arange(T.scale.shape[0]), _CHUNK)]

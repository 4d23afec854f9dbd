"""Where a registration loses the truth: the poses that each stage hands on, recorded while the engine runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchmarks.symmetric_errors import Symmetries
from regnf_core import RegistrationOptions, Sim3
from regnf_core.robust import pipeline
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.evaluation import Evaluation, evaluate_candidates

_POINTS = 60
_STEPS = 60
"""About a free axis: 6 degrees from one to the next, less than a seed's own distance."""


@dataclass(eq=False)
class Recording:
    """Poses in the working frames, one entry an attempt of the search: seeds, searched and refined candidates."""

    problem: RegistrationProblem | None = None
    seeds: list[Sim3] = field(default_factory=list)
    searched: list[PoseCandidates] = field(default_factory=list)
    refined: list[PoseCandidates] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)


@contextmanager
def recorded() -> Iterator[Recording]:
    """Record what the preset robust does within the block."""
    kept = Recording()
    search, refine, evaluate = pipeline.search_poses, pipeline.refine_poses, pipeline.evaluate_candidates

    def searching(*args: Any, **kwargs: Any) -> PoseCandidates:
        kept.seeds.append(args[2])
        kept.searched.append(search(*args, **kwargs))
        return kept.searched[-1]

    def refining(problem: RegistrationProblem, *args: Any, **kwargs: Any) -> PoseCandidates:
        kept.problem = problem
        kept.refined.append(refine(problem, *args, **kwargs))
        return kept.refined[-1]

    def evaluating(*args: Any, **kwargs: Any) -> Evaluation:
        kept.evaluations.append(evaluate(*args, **kwargs))
        return kept.evaluations[-1]

    with (
        patch.object(pipeline, "search_poses", searching),
        patch.object(pipeline, "refine_poses", refining),
        patch.object(pipeline, "evaluate_candidates", evaluating),
    ):
        yield kept


def stage_errors(kept: Recording, truth: Sim3, points: Tensor, symmetries: Symmetries) -> dict[str, Any]:
    """The least MSSD (diameters) of the poses after each stage, and how the nearest seed differs from the truth.

    truth: T_object_scene · points: (N, 3) of the object's surface, its frame.
    """
    problem = kept.problem
    if problem is None:
        return {}
    nearest = NearestTruth(problem, truth, points, symmetries)
    found: dict[str, Any] = {"attempts": len(kept.seeds)}
    if kept.seeds:
        seeds = Sim3.cat(kept.seeds)
        found |= {"seeds": len(seeds), **nearest.of_seeds(seeds)}
    for name, stage in (("searched", kept.searched), ("refined", kept.refined)):
        found[f"{name}_mssd"] = min((float(nearest.errors(one.T).min()) for one in stage), default=float("inf"))
    return found


def from_truth(kept: Recording, truth: Sim3, points: Tensor, symmetries: Symmetries) -> dict[str, Any]:
    """Where a refinement that starts at the truth ends, its verdict and score, and the score of what was chosen."""
    problem = kept.problem
    if problem is None or not kept.evaluations:
        return {}
    nearest = NearestTruth(problem, truth, points, symmetries)
    generator = torch.Generator().manual_seed(0)
    refined = pipeline.refine_poses(problem, problem.in_working_frames(truth)[None], generator)
    evaluation = evaluate_candidates(problem, refined, RegistrationOptions(preset="robust"))
    chosen = kept.evaluations[-1]
    T = problem.in_working_frames(evaluation.T)
    return {
        "truth_mssd": float(nearest.errors(T[None])[0]),
        "truth_score": evaluation.metrics["score"],
        "truth_verdict": evaluation.found.verdict,
        "truth_reason": evaluation.found.reason,
        "chosen_score": chosen.metrics["score"],
    }


class NearestTruth:
    """How far poses between working frames are from the truth or one of its equals by symmetry."""

    def __init__(self, problem: RegistrationProblem, truth: Sim3, points: Tensor, symmetries: Symmetries) -> None:
        T = problem.in_working_frames(truth)
        to_work = problem.model.frame.to_field().inverse()
        S = symmetries.transforms(_STEPS)
        self._points = to_work.apply(_outermost(points))
        self._size = float((self._points[:, None] - self._points[None]).norm(dim=-1).max())
        self._truths = to_work @ S @ to_work.inverse() @ T

    def errors(self, T: Sim3) -> Tensor:
        """(H,): MSSD of poses (H,), diameters."""
        return self._all(T).amin(1)

    def of_seeds(self, T: Sim3) -> dict[str, float]:
        """The seed with the least MSSD: that, and by what its turn (radians), scale (a ratio) and place are off."""
        errors = self._all(T)
        seed = int(errors.amin(1).argmin())
        number = int(errors[seed].argmin())
        truth, best = self._truths[number], T[seed]
        turn = Sim3(torch.ones((), dtype=torch.float64), best.rotation @ truth.rotation.mT, torch.zeros(3).double())
        middle = truth.inverse().apply(self._points).mean(0)[None]
        offset = (best.apply(middle) - truth.apply(middle)).norm() / self._size
        within = float((errors.amin(1) <= 0.25).double().mean())
        return {
            "seed_mssd": float(errors.min()),
            "seed_turn": float(turn.log()[:3].norm()),
            "seed_scale": float(best.scale / truth.scale),
            "seed_offset": float(offset),
            "seeds_within_quarter": within,
        }

    def _all(self, T: Sim3) -> Tensor:
        """(H, K): MSSD of each pose to each of the truth's equals."""
        true = self._truths.inverse().apply(self._points)  # (K, N, 3)
        rows = []
        for start in range(0, len(T), 512):
            placed = T[start : start + 512].inverse().apply(self._points)  # (h, N, 3)
            columns = [(placed - one).norm(dim=-1).amax(1) for one in true]
            rows.append(torch.stack(columns, dim=1))
        return torch.cat(rows) * float(self._truths.scale[0]) / self._size


def _outermost(points: Tensor) -> Tensor:
    """(n, 3): points far apart from each other, the outermost among them."""
    points = points.double()
    chosen = [int((points - points.mean(0)).norm(dim=-1).argmax())]
    gaps = (points - points[chosen[0]]).norm(dim=-1)
    while len(chosen) < min(_POINTS, len(points)):
        chosen.append(int(gaps.argmax()))
        gaps = torch.minimum(gaps, (points - points[chosen[-1]]).norm(dim=-1))
    return points[chosen]


Probe = Callable[[Recording], dict[str, Any]]

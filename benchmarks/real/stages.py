"""Which stage of the preset `robust` loses the truth: the nearest pose to it after each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from benchmarks.robust.cases import Case
from benchmarks.robust.judging import SUCCESS
from regnf_core import RegistrationOptions, RegnfError, Sim3
from regnf_core.fields.observation import CountingField
from regnf_core.geometry.metrics import displacement
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.model import model_object
from regnf_core.robust.pipeline import geometric_seeds, refine_poses, search_poses
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.scene import view_scene
from regnf_core.robust.search.bounds import start_rotations
from regnf_core.robust.search.distance_grid import feature_seeds
from regnf_core.robust.verdict.evaluation import evaluate_candidates

_NEAR = 0.1
"""Diameters: what the search finds so near to the truth, the refinement brings there."""


@dataclass(frozen=True, eq=False)
class _Setting:
    """A registration up to its search, and the truth between the working frames."""

    problem: RegistrationProblem
    truth: Sim3
    generator: torch.Generator
    options: RegistrationOptions

    def nearest(self, T: Sim3) -> float:
        """Of poses T (H,) to the truth, object diameters; infinite where there are none."""
        points = self.problem.model.extremal_points
        return float(displacement(T, self.truth, points).min()) if len(T) else float("inf")


def stages_of(case: Case, seed: int, options: RegistrationOptions | None = None) -> dict[str, Any]:
    """Distances to the truth (object diameters) of the nearest pose after each stage, of the pose that is reached from
    the truth, and its verdict; ``lost_by`` names the first stage without a pose near enough, or the verdict."""
    assert case.truth is not None
    options = options or RegistrationOptions()
    try:
        problem, generator = _problem(case, options, seed)
    except RegnfError as error:
        return {"lost_by": f"samples: {error.reason}"}
    setting = _Setting(problem, problem.in_working_frames(case.truth), generator, options)
    found = _from_truth(setting)
    searched, by_search = _search(setting, seed)
    refined = refine_poses(problem, searched, generator)
    end = evaluate_candidates(problem, refined, options)
    found |= by_search | {
        "nearest_refined": setting.nearest(refined.T),
        "chosen": setting.nearest(refined.T[end.winner][None]),
        "chosen_score": end.metrics["score"],
        "foreground": len(problem.view.foreground),
        "normal_roughness": problem.view.normal_roughness,
    }
    return found | {"lost_by": _lost_by(found, end.verdict)}


def _from_truth(setting: _Setting) -> dict[str, Any]:
    """Where refinement from the truth ends, and the verdict there."""
    held = refine_poses(setting.problem, setting.truth[None], setting.generator)
    found = evaluate_candidates(setting.problem, held, setting.options)
    metrics = {f"truth_{name}": value for name, value in found.metrics.items() if isinstance(value, float)}
    return {
        "truth_in_bound": bool(setting.problem.bound.admits(setting.truth[None]).all()),
        "truth_moves_to": setting.nearest(held.T[:1]),
        "truth_verdict": found.verdict,
        "truth_reason": found.reason,
        **metrics,
    }


def _search(setting: _Setting, seed: int) -> tuple[Sim3, dict[str, Any]]:
    """The poses (H,) that the search ends with, and what is left near the truth after each of its stages, with the
    best score there and that of the truth, refined alike."""
    problem, generator = setting.problem, setting.generator
    view, model = problem.view, problem.model
    seeds = geometric_seeds(view, model, start_rotations(setting.options))
    matched = feature_seeds(view.foreground, model.samples, setting.options.robust.feature_draws, seed)
    poses, left, best, of_truth = Sim3.cat([seeds, matched]), [], [], []
    for stage in SEARCH.stages:
        found = search_poses(view, model, poses, generator, problem.bound, [stage])
        poses = found.T
        left.append(setting.nearest(poses))
        best.append(float(found.scores.min()))
        of_truth.append(
            float(search_poses(view, model, setting.truth[None], generator, problem.bound, [stage]).scores.min())
        )
    return poses, {
        "nearest_seed": setting.nearest(seeds),
        "nearest_feature": setting.nearest(matched),
        "nearest_searched": left[-1],
        "after_search_stages": left,
        "search_scores_best": best,
        "search_scores_truth": of_truth,
    }


def _problem(case: Case, options: RegistrationOptions, seed: int) -> tuple[RegistrationProblem, torch.Generator]:
    generator = torch.Generator().manual_seed(seed)
    view = view_scene(case.scene, case.detection, options.robust)
    obj = CountingField(case.obj)
    model = model_object(obj, options.robust)
    return make_problem(view, model, CountingField(case.scene), obj, options.robust), generator


def _lost_by(found: dict[str, Any], verdict: str) -> str:
    """The first stage that has no pose near the truth any more."""
    if found["truth_moves_to"] > SUCCESS:
        return "truth is not stable"
    if found["nearest_searched"] > _NEAR and found["nearest_refined"] > SUCCESS:
        return "search"
    if found["nearest_refined"] > SUCCESS:
        return "refinement"
    if found["chosen"] > SUCCESS:
        return "choice among poses"
    return "verdict" if verdict == "rejected" else "nothing"

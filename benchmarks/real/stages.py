"""Which stage of the preset `robust` loses the truth: the nearest pose to it after each of them."""

from __future__ import annotations

from typing import Any

import torch

from benchmarks.robust.cases import Case
from benchmarks.robust.judging import SUCCESS
from regnf_core import RegistrationOptions, RegnfError, Sim3
from regnf_core.fields.counting import CountingField
from regnf_core.geometry.pose_distance import displacement
from regnf_core.robust.model.object_model import model_object
from regnf_core.robust.pipeline import geometric_seeds, refine_poses, search_poses
from regnf_core.robust.problem import RegistrationProblem, make_problem
from regnf_core.robust.scene.scene_view import view_scene
from regnf_core.robust.search.features import feature_seeds
from regnf_core.robust.search.rotations import start_rotations
from regnf_core.robust.verdict.evaluation import evaluate_candidates

_NEAR = 0.1
"""Diameters: what the search finds so near to the truth, the refinement brings there."""


def stages_of(case: Case, seed: int, options: RegistrationOptions | None = None) -> dict[str, Any]:
    """Distances to the truth (object diameters) of the nearest pose after each stage, of the pose that is reached from
    the truth, and its verdict; ``lost_by`` names the first stage without a pose near enough, or the verdict."""
    options = options or RegistrationOptions()
    assert case.truth is not None
    try:
        problem, generator = _problem(case, options, seed)
    except RegnfError as error:
        return {"lost_by": f"samples: {error.reason}"}
    points, truth = problem.model.extremal_points, problem.in_working_frames(case.truth)

    def nearest(T: Sim3) -> float:
        return float(displacement(T, truth, points).min()) if len(T) else float("inf")

    held = refine_poses(problem, truth[None], generator)
    at_truth = evaluate_candidates(problem, held, options)
    found: dict[str, Any] = {
        "truth_moves_to": nearest(held.T[:1]),
        "truth_verdict": at_truth.verdict,
        "truth_reason": at_truth.reason,
        **{f"truth_{name}": value for name, value in at_truth.metrics.items() if isinstance(value, float)},
    }
    seeds = geometric_seeds(problem.view, problem.model, start_rotations(options))
    matched = feature_seeds(problem.view.foreground, problem.model.samples, options.robust.feature_draws, seed)
    searched = search_poses(problem.view, problem.model, Sim3.cat([seeds, matched]), generator)
    refined = refine_poses(problem, searched.T, generator)
    end = evaluate_candidates(problem, refined, options)
    found |= {
        "nearest_seed": nearest(seeds),
        "nearest_feature": nearest(matched),
        "nearest_searched": nearest(searched.T),
        "nearest_refined": nearest(refined.T),
        "chosen": nearest(refined.T[end.winner][None]),
        "chosen_score": end.metrics["score"],
        "foreground": len(problem.view.foreground),
        "normal_roughness": problem.view.normal_roughness,
    }
    return found | {"lost_by": _lost_by(found, end.verdict)}


def _problem(case: Case, options: RegistrationOptions, seed: int) -> tuple[RegistrationProblem, torch.Generator]:
    generator = torch.Generator().manual_seed(seed)
    view = view_scene(case.scene, case.detection, options.robust, seed)
    obj = CountingField(case.obj)
    model = model_object(obj, options.robust)
    return make_problem(view, model, CountingField(case.scene), obj, options.robust, generator), generator


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

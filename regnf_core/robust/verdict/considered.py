"""The poses that a registration has looked at to the end, with what speaks for and against each: for people to look at.

Nothing is evaluated for it: the held-out samples tell it that the verdict rests on.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.pose_distance import distinct
from regnf_core.options import RobustOptions
from regnf_core.result import Considered, ConsideredPose
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.answer import Answer
from regnf_core.robust.verdict.criteria import evaluate_pose
from regnf_core.robust.verdict.evidence import Evidence

_MOST = 6


def considered_poses(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    evidence: Evidence,
    answer: Answer,
    features: dict[str, Tensor],
    options: RobustOptions,
) -> Considered:
    """The best of the candidates that differ, the likeliest first. features: (H,) of each."""
    points = problem.model.extremal_points
    ranked = distinct(candidates.T, answer.demerits, points, VERDICT.rivals_min_distance, len(candidates))
    numbers = ranked[:_MOST].tolist()
    poses = []
    for number in numbers:
        likely = float(answer.probability_listed[number])
        of_pose = {name: float(one[number]) for name, one in features.items()}
        found = evaluate_pose(evidence, number, 0, options, of_pose, likely)
        if not bool(problem.bound.admits(candidates.T[torch.tensor([number])])[0]):
            reason = "OUTSIDE_DETECTION"
        else:
            reason = found.reason
        metrics = {**evidence.of(number), "probability": likely}
        metrics["unexplained_share_scene"] = of_pose["unexplained"]
        poses.append(ConsideredPose(problem.in_field_frames(candidates.T[number]), reason, metrics))
    chosen = torch.tensor(numbers)
    scene, obj = problem.held_out.scene_samples, problem.held_out.object_samples
    return Considered(
        poses,
        problem.view.frame.out_of(scene.points),
        problem.model.frame.out_of(obj.points),
        evidence.scene_signs[chosen],
        evidence.object_signs[chosen],
    )

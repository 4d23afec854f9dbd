"""The poses that a registration has looked at to the end, with what speaks for and against each: for people to look at.

Nothing is evaluated for it: the held-out samples tell it that the verdict rests on.
"""

from __future__ import annotations

import torch

from regnf_core.geometry.pose_distance import distinct
from regnf_core.options import RobustOptions
from regnf_core.result import Considered, ConsideredPose
from regnf_core.robust.constants import VERDICT
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import PoseCandidates
from regnf_core.robust.verdict.answer import Answer
from regnf_core.robust.verdict.criteria import evaluate_pose
from regnf_core.robust.verdict.evidence import HeldOut

_MOST = 6


def considered_poses(
    problem: RegistrationProblem,
    candidates: PoseCandidates,
    held_out: HeldOut,
    answer: Answer,
    options: RobustOptions,
) -> Considered:
    """The best of the candidates that differ, the likeliest first."""
    points, evidence = problem.model.extremal_points, held_out.evidence
    ranked = distinct(candidates.T, answer.demerits, points, VERDICT.rivals_min_distance, len(candidates))
    numbers = ranked[:_MOST].tolist()
    poses = []
    for number in numbers:
        likely = float(answer.probability[number])
        found = evaluate_pose(held_out, number, 0, options, likely)
        metrics = {**held_out.of(number), "probability": likely}
        T = problem.in_field_frames(candidates.T[number])
        poses.append(ConsideredPose(T, found.reason, metrics, found.broken))
    chosen = torch.tensor(numbers)
    scene, obj = problem.held_out.scene_samples, problem.held_out.object_samples
    return Considered(
        poses,
        problem.view.frame.out_of(scene.points),
        problem.model.frame.out_of(obj.points),
        evidence.scene_signs[chosen],
        evidence.object_signs[chosen],
    )

"""What one registration is worth: its errors, and the category it falls into."""

from __future__ import annotations

from typing import Any

from benchmarks.symmetric_errors import Symmetries, errors_against_truth
from regnf_core import RegistrationResult, RegnfError, Sim3

SUCCESS = 0.05
"""Largest MSSD of a right pose, object diameters."""
RIGHT, AMONG, REJECTED, FAILED = "registered right", "ambiguous with truth", "rejected", "failed"
WRONG, NOT_AMONG = "REGISTERED WRONG", "ambiguous without truth"
SUCCESSES = (RIGHT, AMONG)
DEFINITION = (
    "Success: `registered` with MSSD (least over the object's true symmetries) at most 5 % of the object's diameter, "
    "or `ambiguous` with such a pose among those listed."
)
_POINTS = 2000
"""Surface points, about, that the errors are taken over."""
_ERRORS = ("mssd_share", "rotation_error_rad", "center_error_share", "scale_error_share", "add_s_share")
_METRICS = (
    "score",
    "inlier_share_object",
    "inlier_share_scene",
    "explained_share_scene",
    "occluded_share_object",
    "free_space_violations",
    "residual_rms",
    "coarse_agreement",
    "unexplained_share_scene",
    "probability",
    "probability_alone",
    "verdict_margin",
    "surface_offset",
    "field_evaluations",
)


def judge(result: RegistrationResult, truth: Sim3 | None, symmetries: Symmetries) -> dict[str, Any]:
    """Verdict, category, errors of the best pose returned, and the evidence. Without truth any pose is wrong."""
    poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
    errors: dict[str, float] = {}
    if truth is not None:
        points = result.object_samples.points
        points = points[:: max(1, len(points) // _POINTS)]
        all_errors = [errors_against_truth(pose, truth, points, symmetries) for pose in poses]
        best = min(all_errors, key=lambda one: one["mssd_share"])
        errors = {name: best[name] for name in _ERRORS}
    right = errors.get("mssd_share", float("inf")) <= SUCCESS
    category = {
        "registered": RIGHT if right else WRONG,
        "ambiguous": AMONG if right else NOT_AMONG,
        "rejected": REJECTED,
    }[result.verdict]
    evidence = {
        name: value for name, value in result.metrics.items() if name in _METRICS or name.startswith("seconds_")
    }
    return {
        "verdict": result.verdict,
        "reason": result.verdict_reason,
        "category": category,
        "poses": len(poses),
        **errors,
        **evidence,
    }


def judge_error(error: RegnfError) -> dict[str, Any]:
    """A registration that ended without a result."""
    return {"verdict": "none", "reason": error.reason or type(error).__name__, "category": FAILED}

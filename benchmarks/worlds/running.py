"""Every case of a world registered: one plain dictionary a registration."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from benchmarks.robust.ellipsoid import mahalanobis_squared, nearest_truth, pose_error
from benchmarks.robust.judging import SUCCESS, judge_error
from benchmarks.symmetric_errors import Symmetries, errors_against_truth
from benchmarks.worlds.cases import ObservedBy, WorldCase, cases_of
from benchmarks.worlds.covariance import diagonal_parts
from benchmarks.worlds.stages import from_truth, recorded, stage_errors
from regnf_core import RegistrationOptions, RegistrationResult, RegnfError, Sim3, register
from regnf_core.options import RobustOptions

Run = dict[str, Any]
_POINTS = 600
_ERRORS = ("mssd_share", "rotation_error_rad", "center_error_share", "scale_error_share")


@dataclass(frozen=True)
class Way:
    """How to register. observed_by: what tells what was seen of the scene · probe: look into the stages as well ·
    known_scale: the scale is said to lie within this share of the true one; None: nothing is said."""

    seed: int = 0
    observed_by: ObservedBy = "images"
    probe: bool = True
    known_scale: float | None = None

    def options(self, truth: Sim3) -> RegistrationOptions:
        """What the registration of a case is asked with."""
        if self.known_scale is None:
            return RegistrationOptions(preset="robust")
        low, high = (float(truth.scale) * (1.0 + side * self.known_scale) for side in (-1.0, 1.0))
        return RegistrationOptions(preset="robust", robust=RobustOptions(min_scale=low, max_scale=high))


def register_world(home: Path, way: Way) -> list[Run]:
    """The runs of all cases of a world's folder."""
    return [_run(case, way) for case in cases_of(home, way.observed_by)]


def _run(world_case: WorldCase, way: Way) -> Run:
    case = world_case.case
    assert case.truth is not None
    options = way.options(case.truth)
    facts: Run = {**world_case.facts, "seed": way.seed, "known_scale": way.known_scale}
    with recorded() as kept:
        begun = time.process_time()
        try:
            result = register(case.scene, case.obj, case.detection, options, way.seed, clouds=False)
        except RegnfError as error:
            return {**facts, "seconds": time.process_time() - begun, **judge_error(error)}
        seconds = time.process_time() - begun
    found = {**facts, "seconds": seconds, **judged(result, world_case)}
    if way.probe:
        points = world_case.points
        found |= stage_errors(kept, case.truth, points, case.symmetries)
        found |= from_truth(kept, case.truth, points, case.symmetries)
    return found


def judged(result: RegistrationResult, world_case: WorldCase) -> Run:
    """Verdict, errors of the pose and of the best of those listed, and the evidence. Errors are over the true surface.

    near_mssd: the least over symmetries that nearly hold as well · mahalanobis_squared: of the true pose, by the
    covariance, and its parts; of right poses alone, and None for objects of revolution: their turn about the axis has
    no truth.
    """
    best, listed = _errors(result, world_case, world_case.case.symmetries)
    near = best if best["mssd_share"] <= SUCCESS else _errors(result, world_case, world_case.near)[0]
    return {
        "verdict": result.verdict,
        "reason": result.verdict_reason,
        "poses": 1 + len(result.alternatives),
        **best,
        "listed_mssd": listed,
        "near_mssd": near["mssd_share"],
        **_by_covariance(result, world_case, best["mssd_share"] <= SUCCESS),
        "metrics": result.metrics,
    }


def _by_covariance(result: RegistrationResult, world_case: WorldCase, right: bool) -> Run:
    """How far the true pose lies from the one found, by the covariance."""
    case, points = world_case.case, _points(world_case)
    assert case.truth is not None
    if not right or result.covariance is None or case.symmetries.continuous:
        return {"mahalanobis_squared": None}
    T = result.T_object_scene
    error = pose_error(T, nearest_truth(T, case.truth, points, case.symmetries))
    offset = result.metrics.get("surface_offset", 0.0) * result.metrics["object_diameter"]
    return {
        "mahalanobis_squared": mahalanobis_squared(error, result.covariance),
        **diagonal_parts(error, result.covariance, points, T, offset),
    }


def _points(world_case: WorldCase) -> Tensor:
    """(N, 3): some of the object's true surface, its frame."""
    return world_case.points[:: max(1, len(world_case.points) // _POINTS)]


def _errors(
    result: RegistrationResult, world_case: WorldCase, symmetries: Symmetries
) -> tuple[dict[str, float], float]:
    truth = world_case.case.truth
    assert truth is not None
    points = _points(world_case)
    poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
    errors = [errors_against_truth(pose, truth, points, symmetries) for pose in poses]
    return {name: errors[0][name] for name in _ERRORS}, min(one["mssd_share"] for one in errors)

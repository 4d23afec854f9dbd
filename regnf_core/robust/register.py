"""The preset `robust` as one call: from two fields and a box to a RegistrationResult."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.counting import CountingField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RegistrationOptions
from regnf_core.result import RegistrationResult
from regnf_core.robust.model.object_model import ObjectModel, model_object
from regnf_core.robust.pipeline import (
    ITERATIONS,
    Outcome,
    Problem,
    find_candidates,
    pose_problem,
    refine_candidates,
    start_rotations,
)
from regnf_core.robust.report import result_of
from regnf_core.robust.scene.scene_view import SceneView, view_scene
from regnf_core.robust.search.features import feature_seeds
from regnf_core.robust.verdict.conclusion import Conclusion, conclude
from regnf_core.run import STARTS, Run

_CLOUD_MARGIN = 0.05  # of the detection box's size


@dataclass(frozen=True, eq=False)
class WarmStart:
    """What is known before a registration with the preset `robust`.

    T_object_scene: its neighborhood is searched first, everything else only if that ends in a rejection ·
    object_model: what ``model_object`` made of the object's field earlier; saves making it again.
    """

    T_object_scene: Sim3 | None = None
    object_model: ObjectModel | None = None


def register_robust(
    scene_field: SdfField,
    object_field: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions,
    seed: int,
    run: Run,
    warm_start: WarmStart | None = None,
    scene_view: SceneView | None = None,
) -> RegistrationResult:
    """T_object_scene from two fields and a box, with a verdict, all equivalent poses and a covariance.

    ``scene_view`` saves making one; it must be of this scene, box, options and seed.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InvalidInputError (FIELD_NOT_FINITE).
    """
    known = warm_start or WarmStart()
    scene, obj = CountingField(scene_field), CountingField(object_field)
    generator = torch.Generator().manual_seed(seed)
    with run.phase("sampling"):
        view = scene_view or view_scene(scene_field, detection, options.robust, seed)
        model = known.object_model or model_object(obj, options.robust)
        problem = pose_problem(view, model, scene, obj, options.robust, generator)
    outcome, conclusion = _best_attempt(problem, options, generator, seed, run, known.T_object_scene)
    evaluations = view.evaluations + scene.evaluations + obj.evaluations
    return result_of(problem, outcome, conclusion, options, seed, evaluations)


def cloud_region(detection: OrientedBox) -> Callable[[Tensor], Tensor]:
    """What says which points (N, 3) of the scene may belong to a result's clouds, (N,) bool.

    Those in the detection box, grown a little. No ground is removed: which way is up need not be known.
    """
    return lambda points: detection.contains(points, _CLOUD_MARGIN)


def _best_attempt(
    problem: Problem,
    options: RegistrationOptions,
    generator: torch.Generator,
    seed: int,
    run: Run,
    T_object_scene_start: Sim3 | None,
) -> tuple[Outcome, Conclusion]:
    """Round a given start, else from the geometry, else from feature matches too: dearer ways where others fail."""
    if T_object_scene_start is not None:
        start = problem.in_working_frames(T_object_scene_start)
        found = _attempt(problem, options, generator, run, T_start=start)
        if found[1].verdict != "rejected":
            return found
    found = _attempt(problem, options, generator, run)
    if found[1].verdict != "rejected" or options.robust.feature_draws == 0:
        return found
    matched = feature_seeds(problem.view.foreground, problem.model.samples, options.robust.feature_draws, seed)
    if matched.scale.numel() == 0:
        return found
    again = _attempt(problem, options, generator, run, more_seeds=matched)
    return min(found, again, key=lambda one: one[1].rank)


def _attempt(
    problem: Problem,
    options: RegistrationOptions,
    generator: torch.Generator,
    run: Run,
    T_start: Sim3 | None = None,
    more_seeds: Sim3 | None = None,
) -> tuple[Outcome, Conclusion]:
    with run.phase("initializing"):
        candidates, _ = find_candidates(
            problem.view, problem.model, start_rotations(options), generator, T_start, more_seeds=more_seeds
        )
    with run.phase("optimizing"):
        outcome = refine_candidates(problem, candidates, options.robust, generator, _steps(run))
    with run.phase("verifying"):
        return outcome, conclude(problem, outcome, options)


def _steps(run: Run) -> Callable[[], None]:
    """What to call after each iteration: reports the share done, and lets the caller cancel."""
    taken = count(1)
    span = STARTS["verifying"] - STARTS["optimizing"]
    return lambda: run.report("optimizing", STARTS["optimizing"] + span * next(taken) / ITERATIONS)

"""The preset `robust` as one call: from two fields and a box to a RegistrationResult."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any

import torch
from torch import Tensor

from regnf_core.box import OrientedBox
from regnf_core.fields.base import CountingField, SdfField
from regnf_core.options import RegistrationOptions
from regnf_core.result import Alternative, IterationRecord, RegistrationResult, SurfaceSamples
from regnf_core.robust.covariance import covariance, in_object_units
from regnf_core.robust.engine import ITERATIONS, Outcome, Problem, find_candidates, pose_problem, refine_candidates
from regnf_core.robust.finalists import LAST, Trail
from regnf_core.robust.judgement import verdict
from regnf_core.robust.levenberg import fitting_width
from regnf_core.robust.object_model import ObjectModel, model_object
from regnf_core.robust.poses import distinct, select
from regnf_core.robust.relation import relation
from regnf_core.robust.residuals import Samples, residuals
from regnf_core.robust.scene_view import view_scene
from regnf_core.run import STARTS, Run
from regnf_core.sim3 import Sim3

_RIVALS_APART = 0.1  # object diameters: poses closer together are one answer with its uncertainty
_MARGIN_PER_SCORE = 0.15  # the worse the fields agree at all, the less a difference says
_GEMAN_MCCLURE = -2.0  # as the shape of Barron's general kernel


def register_robust(
    scene_field: SdfField,
    object_field: SdfField,
    detection: OrientedBox,
    options: RegistrationOptions,
    seed: int,
    run: Run,
    T_object_scene_start: Sim3 | None = None,
    object_model: ObjectModel | None = None,
) -> RegistrationResult:
    """T_object_scene from nothing but two fields and a box, with a verdict, all equal poses and a covariance.

    With ``T_object_scene_start`` its neighbourhood is searched first, and everything only if that ends in a rejection.
    ``object_model`` saves the making of one; it must be this object's.
    Deterministic for a seed, on one machine and with the same number of threads.
    Raises InvalidDetectionError, NoSurfaceError, InvalidInputError (FIELD_NOT_FINITE).
    """
    scene, obj = CountingField(scene_field), CountingField(object_field)
    generator = torch.Generator().manual_seed(seed)
    with run.phase("sampling"):
        view = view_scene(scene, detection, options.robust, generator)
        model = object_model or model_object(obj, options.robust)
        problem = pose_problem(view, model, obj, options.robust, generator)
    T_start = None if T_object_scene_start is None else _in_working_frames(problem, T_object_scene_start)
    outcome, ending = _attempt(problem, options, generator, run, T_start)
    if T_start is not None and ending.verdict == "rejected":
        outcome, ending = _attempt(problem, options, generator, run, None)
    ending.metrics["field_evaluations"] = float(scene.evaluations + obj.evaluations)
    return RegistrationResult(
        verdict=ending.verdict,
        verdict_reason=ending.reason,
        T_object_scene=ending.T,
        T_object_scene_initial=_in_field_frames(problem, select(outcome.T_initial, torch.tensor(ending.winner))),
        scene_samples=_surface(view.foreground, view.frame.out_of),
        object_samples=_surface(model.samples, model.frame.out_of),
        metrics=ending.metrics,
        trace=_trace(problem, outcome.finalists.trail, ending.winner),
        residuals={},
        seed=seed,
        options=options.to_dict(),
        alternatives=ending.alternatives,
        covariance=ending.covariance,
        symmetry=model.symmetry.group(),
    )


def _attempt(
    problem: Problem,
    options: RegistrationOptions,
    generator: torch.Generator,
    run: Run,
    T_start: Sim3 | None,
) -> tuple[Outcome, _Ending]:
    with run.phase("initialising"):
        candidates, _ = find_candidates(problem.view, problem.model, options.robust, generator, T_start)
    with run.phase("optimising"):
        outcome = refine_candidates(problem, candidates, options.robust, generator, _steps(run))
    with run.phase("verifying"):
        return outcome, _conclude(problem, outcome, options)


def _steps(run: Run) -> Callable[[], None]:
    """What to call after each iteration: reports the share done, and lets the caller cancel."""
    taken = count(1)
    span = STARTS["verifying"] - STARTS["optimising"]
    return lambda: run.report("optimising", STARTS["optimising"] + span * next(taken) / ITERATIONS)


@dataclass(frozen=True)
class _Ending:
    verdict: Any
    reason: str
    winner: int
    T: Sim3
    metrics: dict[str, float]
    alternatives: list[Alternative]
    covariance: Tensor


def _conclude(problem: Problem, outcome: Outcome, options: RegistrationOptions) -> _Ending:
    """The winner by the held-out samples, its rivals, verdict and covariance."""
    evidence, poses = outcome.evidence, outcome.finalists.T
    winner = int(evidence.scores.argmin())
    ranked = distinct(poses, evidence.scores, problem.model.extremes, _RIVALS_APART, poses.scale.numel())
    best = float(evidence.scores[winner])
    close = evidence.scores <= best + options.robust.rival_margin + _MARGIN_PER_SCORE * best
    rivals = [i for i in ranked.tolist() if i != winner and close[i]]
    decision, reason = verdict(evidence, winner, len(rivals), options.robust)
    T_work = select(poses, torch.tensor(winner))
    T = _in_field_frames(problem, T_work)
    alternatives = []
    axis = problem.model.symmetry.axis
    for i in rivals if decision != "rejected" else []:
        other = _in_field_frames(problem, select(poses, torch.tensor(i)))
        alternatives.append(Alternative(other, float(evidence.scores[i]), relation(other, T, axis)))
    diameter = problem.model.frame.length
    metrics = {
        **evidence.of(winner),
        "object_diameter": diameter,
        "iterations": float(len(outcome.finalists.trail.steps)),
        "finalists": float(evidence.scores.numel()),
    }
    return _Ending(decision, reason, winner, T, metrics, alternatives, _covariance(problem, T_work))


def _covariance(problem: Problem, T_work: Sim3) -> Tensor:
    A, B = problem.A, problem.B
    batch = Sim3(T_work.scale[None], T_work.rotation[None], T_work.translation[None])
    r = residuals(problem.view.field, problem.object_field, A, B, batch)
    cov = covariance(r, fitting_width(r, LAST.widths[-1]))
    return in_object_units(cov, T_work, problem.view.frame, problem.model.frame)


def _in_field_frames(problem: Problem, T_work: Sim3) -> Sim3:
    return problem.model.frame.to_field() @ T_work @ problem.view.frame.to_field().inverse()


def _in_working_frames(problem: Problem, T: Sim3) -> Sim3:
    return problem.model.frame.to_field().inverse() @ T @ problem.view.frame.to_field()


def _surface(samples: Samples, out_of: Any) -> SurfaceSamples:
    return SurfaceSamples(out_of(samples.on_surface()).float(), samples.normals)


def _trace(problem: Problem, trail: Trail, winner: int) -> list[IterationRecord]:
    size = problem.model.frame.length
    records = []
    for iteration, step in enumerate(trail.steps):
        T = _in_field_frames(problem, select(step.T, torch.tensor(winner)))
        records.append(
            IterationRecord(
                iteration=iteration,
                loss=float(step.costs[winner]),
                residual_scene=float(step.residual_scene[winner]) * size,
                residual_object=float(step.residual_object[winner]) * size / float(T.scale),
                regulariser=0.0,
                kernel_shape=_GEMAN_MCCLURE,
                kernel_scale=step.width * size,
                scene_samples=min(step.samples, len(problem.A)),
                object_samples=min(step.samples, len(problem.B)),
                T_object_scene=T,
            )
        )
    return records

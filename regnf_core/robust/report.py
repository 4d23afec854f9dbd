"""From an outcome and its conclusion to the result that callers get."""

from __future__ import annotations

from typing import Any

from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import RegistrationOptions
from regnf_core.result import IterationRecord, RegistrationResult
from regnf_core.robust.pipeline import Outcome, Problem
from regnf_core.robust.refine.pose_candidates import Trail
from regnf_core.robust.residuals import Samples
from regnf_core.robust.verdict.conclusion import Conclusion, pose_covariance

_GEMAN_MCCLURE = -2.0  # as the shape of Barron's general kernel


def result_of(
    problem: Problem,
    outcome: Outcome,
    conclusion: Conclusion,
    options: RegistrationOptions,
    seed: int,
    evaluations: int,
) -> RegistrationResult:
    """The result in the fields' own frames. evaluations: of both fields, all told."""
    view, model = problem.view, problem.model
    initial = outcome.T_initial[conclusion.winner]
    return RegistrationResult(
        verdict=conclusion.verdict,
        verdict_reason=conclusion.reason,
        T_object_scene=conclusion.T,
        T_object_scene_initial=problem.in_field_frames(initial),
        scene_samples=_surface(view.foreground, view.frame.out_of),
        object_samples=_surface(model.samples, model.frame.out_of),
        metrics={**conclusion.metrics, "field_evaluations": float(evaluations)},
        trace=_trace(problem, outcome.finalists.trail, conclusion.winner),
        residuals={},
        seed=seed,
        options=options.to_dict(),
        alternatives=conclusion.alternatives,
        covariance=pose_covariance(problem, conclusion.T_work, outcome.finalists.offsets[conclusion.winner]),
        symmetry=model.symmetry.group(),
    )


def _surface(samples: Samples, out_of: Any) -> SurfaceSamples:
    return SurfaceSamples(out_of(samples.on_surface()).float(), samples.normals)


def _trace(problem: Problem, trail: Trail, winner: int) -> list[IterationRecord]:
    size = problem.model.frame.length
    records = []
    for iteration, step in enumerate(trail.steps):
        T = problem.in_field_frames(step.T[winner])
        records.append(
            IterationRecord(
                iteration=iteration,
                loss=float(step.costs[winner]),
                residual_scene=float(step.residual_scene[winner]) * size,
                residual_object=float(step.residual_object[winner]) * size / float(T.scale),
                regularizer=0.0,
                kernel_shape=_GEMAN_MCCLURE,
                kernel_scale=step.width * size,
                scene_samples=min(step.samples, len(problem.A)),
                object_samples=min(step.samples, len(problem.B)),
                T_object_scene=T,
            )
        )
    return records

"""From an evaluation to the result that callers get, in the fields' own frames."""

from __future__ import annotations

from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import RegistrationOptions
from regnf_core.result import IterationRecord, RegistrationResult
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.pose_candidates import Step
from regnf_core.robust.samples import Samples
from regnf_core.robust.verdict.evaluation import Evaluation, pose_covariance
from regnf_core.robust.working_frame import WorkingFrame

_GEMAN_MCCLURE = -2.0
"""The Geman-McClure kernel as the shape of Barron's general kernel (CVPR 2019)."""


def result_of(
    problem: RegistrationProblem, evaluation: Evaluation, options: RegistrationOptions, seed: int, evaluations: int
) -> RegistrationResult:
    """The result of a registration. evaluations: of both fields, in total."""
    view, model, winner = problem.view, problem.model, evaluation.winner
    history = evaluation.candidates.history
    return RegistrationResult(
        verdict=evaluation.verdict,
        verdict_reason=evaluation.reason,
        verdict_limit=evaluation.found.broken,
        T_object_scene=evaluation.T,
        T_object_scene_initial=problem.in_field_frames(history[0].T[winner]),
        scene_samples=_surface(view.foreground, view.frame),
        object_samples=_surface(model.samples, model.frame),
        metrics={**evaluation.metrics, "field_evaluations": float(evaluations)},
        trace=[_record(problem, number, step, winner) for number, step in enumerate(history)],
        residuals={},
        seed=seed,
        options=options.to_dict(),
        alternatives=evaluation.alternatives,
        considered=evaluation.considered,
        center_object=model.frame.center.clone(),
        covariance=pose_covariance(problem, evaluation),
        symmetry=model.symmetry.to("cpu").group(),
    )


def _surface(samples: Samples, frame: WorkingFrame) -> SurfaceSamples:
    return SurfaceSamples(frame.out_of(samples.on_surface()), samples.normals.cpu())


def _record(problem: RegistrationProblem, iteration: int, step: Step, winner: int) -> IterationRecord:
    """One iteration of the pose that won."""
    size = problem.model.frame.length
    T = problem.in_field_frames(step.T[winner])
    return IterationRecord(
        iteration=iteration,
        loss=float(step.costs[winner]),
        residual_scene=float(step.residual_scene[winner]) * size,
        residual_object=float(step.residual_object[winner]) * size / float(T.scale),
        regularizer=0.0,
        kernel_shape=_GEMAN_MCCLURE,
        kernel_scale=step.width * size,
        scene_samples=min(step.samples, len(problem.fit.scene_samples)),
        object_samples=min(step.samples, len(problem.fit.object_samples)),
        T_object_scene=T,
    )

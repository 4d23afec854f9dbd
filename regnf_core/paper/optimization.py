"""Adam on translation, Euler angles, scale and kernel (paper, sections III-C to III-E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.geometry.euler import euler_from_rotation, rotation_from_euler
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import OptimizationOptions, RegistrationOptions
from regnf_core.paper.kernel import AdaptiveKernel
from regnf_core.paper.loss import LossTerms, SampleSet, bidirectional_loss
from regnf_core.paper.resampling import resample
from regnf_core.result import IterationRecord

_MIN_SCALE = 1e-3  # the published scale is additive and may step over zero, which would mirror the object


@dataclass(frozen=True)
class Refinement:
    """The last iterate, the history of all iterations, and whether the residuals fell under the stopping value."""

    T_object_scene: Sim3
    trace: list[IterationRecord]
    converged: bool


class PoseParameters:
    """T = T_translation R_euler diag(s) as learned numbers, float64 on the CPU: t (3,), Euler angles (3,), s ()."""

    def __init__(self, T: Sim3) -> None:
        self.translation = T.translation.detach().clone().double().cpu().requires_grad_()
        self.angles = euler_from_rotation(T.rotation.detach().double().cpu()).requires_grad_()
        self.scale = T.scale.detach().clone().double().cpu().requires_grad_()

    def transform(self) -> Sim3:
        """The transform of the present numbers, differentiable in them."""
        return Sim3(self.scale, rotation_from_euler(self.angles), self.translation)

    def snapshot(self) -> Sim3:
        """The transform of the present numbers, cut from the graph and from later steps."""
        return Sim3(
            self.scale.detach().clone(),
            rotation_from_euler(self.angles.detach()),
            self.translation.detach().clone(),
        )

    def keep_valid(self) -> None:
        """Hold the scale above zero."""
        with torch.no_grad():
            self.scale.clamp_(min=_MIN_SCALE)


def refine(
    scene: SdfField,
    obj: SdfField,
    scene_samples: SurfaceSamples,
    object_samples: SurfaceSamples,
    T_object_scene_initial: Sim3,
    options: RegistrationOptions,
    generator: torch.Generator,
    on_iteration: Callable[[IterationRecord], None] = lambda record: None,
) -> Refinement:
    """Minimize the bidirectional loss from the initial transform.

    ``on_iteration`` is called once an iteration and may raise to stop the work.
    Raises InvalidInputError (FIELD_NOT_FINITE) when a field gives NaN or infinity on the way.
    """
    A, B = SampleSet.of(scene, scene_samples.points), SampleSet.of(obj, object_samples.points)
    pose, kernel = PoseParameters(T_object_scene_initial), AdaptiveKernel()
    adam = _adam(pose, kernel, options.optimization)
    trace: list[IterationRecord] = []
    for iteration in range(options.optimization.iterations):
        T = pose.transform()
        if iteration > 0 and iteration % options.resampling.every == 0:
            T_now = pose.snapshot()
            A = resample(A, scene, obj, T_now, options.resampling, generator)
            B = resample(B, obj, scene, T_now.inverse(), options.resampling, generator)
        count = options.optimization.samples_per_iteration
        batch_A, batch_B = A.batch(count, generator), B.batch(count, generator)
        terms = bidirectional_loss(scene, obj, batch_A, batch_B, T, kernel, options.optimization.regularizer_weight)
        trace.append(_record(iteration, terms, kernel, pose.snapshot(), (A, B)))
        on_iteration(trace[-1])
        if _converged(trace[-1], options.optimization):
            return Refinement(pose.snapshot(), trace, converged=True)
        adam.zero_grad()
        terms.total.backward()  # type: ignore[no-untyped-call]
        adam.step()
        pose.keep_valid()
    return Refinement(pose.snapshot(), trace, converged=False)


def _adam(pose: PoseParameters, kernel: AdaptiveKernel, options: OptimizationOptions) -> torch.optim.Adam:
    groups: list[tuple[Tensor, float]] = [
        (pose.translation, options.translation_rate),
        (pose.angles, options.rotation_rate),
        (pose.scale, options.scale_rate),
        (kernel.latents, options.kernel_rate),
    ]
    return torch.optim.Adam([{"params": [parameter], "lr": rate} for parameter, rate in groups])


def _record(
    iteration: int, terms: LossTerms, kernel: AdaptiveKernel, T: Sim3, sets: tuple[SampleSet, SampleSet]
) -> IterationRecord:
    loss = float(terms.total.detach())
    if not torch.isfinite(terms.total.detach()):
        raise InvalidInputError("the field gives values that are not finite", reason="FIELD_NOT_FINITE")
    return IterationRecord(
        iteration=iteration,
        loss=loss,
        residual_scene=float(terms.residuals_scene.detach().mean()),
        residual_object=float(terms.residuals_object.detach().mean()),
        regularizer=float(terms.regularizer.detach()),
        kernel_shape=float(kernel.shape.detach()),
        kernel_scale=float(kernel.scale.detach()),
        scene_samples=sets[0].points.shape[0],
        object_samples=sets[1].points.shape[0],
        T_object_scene=T,
    )


def _converged(record: IterationRecord, options: OptimizationOptions) -> bool:
    """The paper's early stopping, asked of both directions."""
    return max(record.residual_scene, record.residual_object) <= options.stop_residual

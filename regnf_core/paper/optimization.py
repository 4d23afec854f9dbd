"""Adam on translation, Euler angles, scale and kernel (paper, sections III-C to III-E)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.document import IterationRecord
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField, differentiable_signed_distance
from regnf_core.geometry.metrics import NearestNeighbors, euler_from_rotation, rotation_from_euler
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import RegistrationOptions, ResamplingOptions

# Barron's general and adaptive robust kernel ("A General and Adaptive Robust Loss Function", CVPR 2019).
#
#     rho(r, alpha, p) = |alpha - 2| / alpha * (((r / p)^2 / |alpha - 2| + 1)^(alpha / 2) - 1)
#
# alpha is the shape (1: Charbonnier, towards 0: Cauchy), p the scale. Minimized over p on its own, rho has no
# minimum: it falls towards zero as p grows. Learning p therefore needs the adaptive form, the negative log likelihood
# of the density whose exponent is -rho, and its normalizer p Z(alpha):
#
#     kappa(r; alpha, p) = rho(r, alpha, p) + log p + log Z(alpha),   Z(alpha) = integral of exp(-rho(x, alpha, 1))
#   dx.

SHAPE_RANGE = (0.001, 1.0)  # within the paper's (0, 1]; the lower end keeps alpha / 2 away from zero
SCALE_FLOOR = 1e-5  # Barron's; keeps r / p finite
_NODES = 601
_REACH = 60.0  # x = sinh(u), |u| up to this: exp(60) is far beyond where the heaviest tail has faded


def robust_kernel(residual: Tensor, shape: Tensor | float, scale: Tensor | float) -> Tensor:
    """rho(r, alpha, p), elementwise, for alpha within (0, 2). Zero at r = 0; differentiable in all three."""
    a = torch.as_tensor(shape, dtype=residual.dtype, device=residual.device)
    gap = 2.0 - a
    return gap / a * torch.expm1(a / 2 * torch.log1p((residual / scale).square() / gap))


def log_partition(shape: Tensor) -> Tensor:
    """log Z(alpha), (), by the trapezoidal rule after x = sinh(u). Differentiable in alpha.

    The rule converges exponentially for such integrands; no table to look up, none to ship.
    """
    u = torch.linspace(0.0, _REACH, _NODES, dtype=torch.float64, device=shape.device)
    log_weight = u + torch.log1p(torch.exp(-2 * u)) - math.log(2.0)  # log cosh(u) = log dx/du
    log_value = log_weight - robust_kernel(u.sinh(), shape.double(), 1.0)
    ends = torch.zeros_like(u)
    ends[0] = ends[-1] = math.log(0.5)
    step = _REACH / (_NODES - 1)
    return (torch.logsumexp(log_value + ends, 0) + math.log(2.0 * step)).to(shape.dtype)


class AdaptiveKernel:
    """The kernel with learned shape and scale.

    Both are functions of unconstrained latents, as Barron proposes: the shape a sigmoid stretched over SHAPE_RANGE,
    the scale a softplus above SCALE_FLOOR. ``latents`` (2,) float64 is the optimizer's parameter. The scale starts
    at 1, the shape in the middle of its range.
    """

    def __init__(self, scale: float = 1.0) -> None:
        raw_scale = math.log(math.expm1(scale - SCALE_FLOOR))  # inverse softplus
        self.latents = torch.tensor([0.0, raw_scale], dtype=torch.float64, requires_grad=True)

    @property
    def shape(self) -> Tensor:
        """alpha, ()."""
        low, high = SHAPE_RANGE
        return low + (high - low) * torch.sigmoid(self.latents[0])

    @property
    def scale(self) -> Tensor:
        """p, ()."""
        return torch.nn.functional.softplus(self.latents[1]) + SCALE_FLOOR

    def negative_log_likelihood(self, residuals: tuple[Tensor, ...]) -> Tensor:
        """Sum over the sets of the mean of kappa over each set (N_i,); ()."""
        shape, scale = self.shape, self.scale
        normalizer = scale.log() + log_partition(shape)
        means = [robust_kernel(r.double(), shape, scale).mean() for r in residuals]
        return torch.stack(means).sum() + len(means) * normalizer


# The bidirectional registration loss (paper, section III-C and III-E).
#
#     L = E_{x in A} kappa(|S_a(x) - S_b(T x)|) + E_{z in B} kappa(|S_b(z) - S_a(T^-1 z)|) + w L_r
#
# A are samples of the scene a, B of the object b, T = T_object_scene. As published, the residuals leave out the
# scale: a distance in object units is compared with one in scene units. The verification, which is ours, keeps it.


@dataclass(frozen=True)
class SampleSet:
    """Samples of one field with what does not change while the transform does.

    points: (N, 3) float32, field frame · own_distance: (N,) the value there · neighbors: search among all points.
    """

    points: Tensor
    own_distance: Tensor
    neighbors: NearestNeighbors

    @classmethod
    def of(cls, field: SdfField, points: Tensor) -> SampleSet:
        """The set of these points (N, 3) of the field's frame."""
        return cls.from_distances(points, field.signed_distance(points).to(points))

    def batch(self, count: int, generator: torch.Generator) -> SampleSet:
        """``count`` of the samples drawn at random by the (CPU) generator; the search stays over all of them."""
        size = self.points.shape[0]
        if size <= count:
            return self
        chosen = torch.randperm(size, generator=generator)[:count].to(self.points.device)
        return SampleSet(self.points[chosen], self.own_distance[chosen], self.neighbors)

    @classmethod
    def from_distances(cls, points: Tensor, own_distance: Tensor) -> SampleSet:
        """The set of points (N, 3) whose field values (N,) are known already."""
        return cls(points, own_distance, NearestNeighbors(points))


@dataclass(frozen=True)
class LossTerms:
    """The loss () and its parts: residuals (N,) of A and (M,) of B, both >= 0, and the regularizer ()."""

    total: Tensor
    residuals_scene: Tensor
    residuals_object: Tensor
    regularizer: Tensor


def residuals(samples: SampleSet, other: SdfField, T_other_own: Sim3) -> Tensor:
    """r = |S_own(x) - S_other(T_other_own x)| (N,) at the samples; differentiable in the transform."""
    moved = T_other_own.apply(samples.points)
    return (samples.own_distance - differentiable_signed_distance(other, moved)).abs()


def regularizer(moved: Tensor, target: SampleSet) -> Tensor:
    """L_r: mean squared distance () from the points (N, 3) to their nearest sample of ``target``, in its frame."""
    _, nearest = target.neighbors.query(moved)
    points = target.neighbors.points
    return (moved - points[nearest.to(points.device)].to(moved)).square().sum(-1).mean()


def bidirectional_loss(
    scene: SdfField,
    obj: SdfField,
    scene_samples: SampleSet,
    object_samples: SampleSet,
    T_object_scene: Sim3,
    kernel: AdaptiveKernel,
    regularizer_weight: float,
) -> LossTerms:
    """The loss at the transform, differentiable in it and in the kernel's latents."""
    r_scene = residuals(scene_samples, obj, T_object_scene)
    r_object = residuals(object_samples, scene, T_object_scene.inverse())
    spread = regularizer(T_object_scene.apply(scene_samples.points), object_samples)
    likelihood = kernel.negative_log_likelihood((r_scene, r_object))
    return LossTerms(likelihood + regularizer_weight * spread.to(likelihood), r_scene, r_object, spread)


# Algorithm 1 of the paper: new samples near both surfaces, by random shifts of the old ones.

_SPACING = 10.0  # a new sample keeps rho / 10 from all old ones


def field_radius(field: SdfField) -> float:
    """r: half the longest edge of the field's bounds; 1 for the usual bounds [-1, 1]^3."""
    return 0.5 * float((field.bounds[1] - field.bounds[0]).max())


def resample(
    samples: SampleSet,
    own: SdfField,
    other: SdfField,
    T_other_own: Sim3,
    options: ResamplingOptions,
    generator: torch.Generator,
) -> SampleSet:
    """The old samples and the shifted ones that Algorithm 1 accepts, at random at most ``max_samples`` of them.

    The conditions, cheapest first, so that the fields are evaluated at few points:
    distance to the old samples >= rho / 10, |S_own(x)| <= omega_1, |S_other(T x)| <= omega_2, r(x) <= xi.
    """
    rho = options.radius_fraction * field_radius(own)
    # U[-1, 1]^3 for each, drawn on the CPU, so that every device sees the same numbers
    shifts = 2.0 * torch.rand(samples.points.shape, generator=generator) - 1.0
    candidates = samples.points + rho * shifts.to(samples.points)
    spacing, _ = samples.neighbors.query(candidates)
    candidates = candidates[spacing >= rho / _SPACING]
    own_distance = own.signed_distance(candidates).to(candidates)
    near = own_distance.abs() <= options.own_distance
    candidates, own_distance = candidates[near], own_distance[near]
    other_distance = other.signed_distance(T_other_own.apply(candidates)).to(candidates)
    accepted = other_distance.abs() <= options.other_distance
    accepted &= (own_distance - other_distance).abs() <= options.residual
    points = torch.cat([samples.points, candidates[accepted]])
    distance = torch.cat([samples.own_distance, own_distance[accepted]])
    if points.shape[0] > options.max_samples:
        kept = torch.randperm(points.shape[0], generator=generator)[: options.max_samples].to(points.device)
        points, distance = points[kept], distance[kept]
    return SampleSet.from_distances(points, distance)


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
        angles = self.angles.detach()
        return Sim3(self.scale.detach().clone(), rotation_from_euler(angles), self.translation.detach().clone())


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
    rates = options.optimization
    learned = {
        pose.translation: rates.translation_rate,
        pose.angles: rates.rotation_rate,
        pose.scale: rates.scale_rate,
        kernel.latents: rates.kernel_rate,
    }
    adam = torch.optim.Adam([{"params": [parameter], "lr": rate} for parameter, rate in learned.items()])
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
        # the paper's early stopping, asked of both directions
        if max(trace[-1].residual_scene, trace[-1].residual_object) <= options.optimization.stop_residual:
            return Refinement(pose.snapshot(), trace, converged=True)
        adam.zero_grad()
        terms.total.backward()  # type: ignore[no-untyped-call]
        adam.step()
        with torch.no_grad():
            pose.scale.clamp_(min=_MIN_SCALE)
    return Refinement(pose.snapshot(), trace, converged=False)


def _record(
    iteration: int, terms: LossTerms, kernel: AdaptiveKernel, T: Sim3, sets: tuple[SampleSet, SampleSet]
) -> IterationRecord:
    loss = float(terms.total.detach())
    if not torch.isfinite(terms.total.detach()):
        raise InvalidInputError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")
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

"""The bidirectional registration loss (paper, section III-C and III-E).

    L = E_{x in A} kappa(|S_a(x) - S_b(T x)|) + E_{z in B} kappa(|S_b(z) - S_a(T^-1 z)|) + w L_r

A are samples of the scene a, B of the object b, T = T_object_scene. As published, the residuals leave out the scale:
a distance in object units is compared with one in scene units. The verification, which is ours, keeps it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField, differentiable_signed_distance
from regnf_core.geometry.points import NearestNeighbors
from regnf_core.geometry.sim3 import Sim3
from regnf_core.paper.kernel import AdaptiveKernel


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

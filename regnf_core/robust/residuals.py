"""The two residuals of a pose and their derivatives with respect to a left perturbation (omega, dt, log-scale step).

With y = T x for scene points x, w = T^-1 z for object points z, g the fields' gradients:

    r1 = S_b(y) - s S_a(x)    s d(r1/s) = [ (y-t) x g_b,      g_b,    g_b . (y-t) - S_b(y)        ]
    r2 = s S_a(w) - S_b(z)    s d(r2/s) = [ -(z-t) x (R g_a), -R g_a, S_b(z) - (R g_a) . (z-t)    ]

Both vanish for all points, on the surface or off it, when S_b(T x) = s S_a(x): the scale is part of them. What is
differentiated is the residual as a length of the scene, r/s: as a length of the object it would fall with s alone, and
so make every object that is seen from one side too large (benchmarks/notes/refinement.md).

Fields learned from images are too thick or too thin by about the same amount everywhere. The two surfaces are then an
offset d apart, S_b(T x) = s S_a(x) + d, and what vanishes is r1 - d and r2 + d.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.working_frame import (
    Samples,
    UnobservedTest,
    WorkingField,
    WorkingObservation,
    not_finite,
    subsample,
)


class DistanceModel(Protocol):
    """Anything that gives a signed distance (M,) and its gradient (M, 3) at points (M, 3)."""

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True, eq=False)
class SurfacePair(Bundle):
    """The scene's and the object's surface: a distance model and samples of each, in their working frames.

    ahead: how far in front of the scene's samples the object is asked, units of the scene's working frame. The answer
    is carried back to the sample along the object's gradient there, so that of a thin wall the face that was seen
    answers, however noisy the sample is; 0: at the samples.
    """

    scene: DistanceModel
    obj: DistanceModel
    scene_samples: Samples
    object_samples: Samples
    ahead: float = 0.0

    def require_finite(self) -> None:
        """Raises InvalidInputError (FIELD_NOT_FINITE) for what a field said where nobody could read it."""
        for model in (self.scene, self.obj):
            if isinstance(model, WorkingField):
                model.require_finite()

    def subsample(self, limit: int, generator: torch.Generator) -> SurfacePair:
        """The pair with at most ``limit`` samples of each surface, at random."""
        few_scene = subsample(self.scene_samples, limit, generator)
        few_object = subsample(self.object_samples, limit, generator)
        return replace(self, scene_samples=few_scene, object_samples=few_object)


@dataclass(frozen=True, eq=False)
class Residuals(Bundle):
    """Residuals (H, N + M) of H poses, scene samples first, object units; their Jacobian (H, N + M, 7), at fixed units
    of the scene: s d(r/s). Its column of the scale is that without an offset, whose part is next to nothing where
    the offset is at its best.

    Vectors are kept as planes, (H, 3, N) and (H, 7, N), so that all work runs along long rows; the Jacobian is such a
    tensor, seen from the other side.

    cosines: (H, N + M), between a sample's normal and the other field's gradient where the pose carries the sample ·
    unobserved: (H, N + M) bool, object samples that come to lie where the scene was not observed, and samples of both
    that face such space while the other surface there does not face the same way; None: all of it was observed ·
    offset: (H,) how much farther out the scene's surface lies than the object's, object units; already subtracted from
    the values.
    """

    values: Tensor
    jacobian: Tensor
    cosines: Tensor
    scene_count: int
    unobserved: Tensor | None = None
    offset: Tensor | None = None

    @property
    def scene_to_object(self) -> Tensor:
        """(H, N) r1, of the scene samples."""
        return self.values[:, : self.scene_count]

    @property
    def object_to_scene(self) -> Tensor:
        """(H, M) r2, of the object samples."""
        return self.values[:, self.scene_count :]

    def means(self, of_samples: Tensor) -> tuple[Tensor, Tensor]:
        """(H,) and (H,): the means of a quantity (H, N + M) of the samples over each direction."""
        n = self.scene_count
        return of_samples[:, :n].mean(1), of_samples[:, n:].mean(1)

    def weighted(self, weights: Tensor) -> Tensor:
        """Weights (H, N + M) of the samples as parts of these means."""
        n, m = self.scene_count, weights.shape[1] - self.scene_count
        return torch.cat([weights[:, :n] / n, weights[:, n:] / m], 1)

    def jacobian_with_offset(self) -> Tensor:
        """The Jacobian (H, N + M, 7), or (H, N + M, 8) where there is an offset: its column is the last one."""
        if self.offset is None:
            return self.jacobian
        # r1 falls and r2 grows where the scene's surface lies farther out
        column = torch.ones_like(self.values[:, None])
        column[..., : self.scene_count] = -1.0
        return torch.cat([self.jacobian.mT, column.to(self.jacobian)], 1).mT

    @classmethod
    def where(cls, mask: Tensor, first: Residuals, second: Residuals) -> Residuals:
        """Those of ``first`` for the poses where ``mask`` (H,) is set, those of ``second`` for the others."""
        return cls(
            torch.where(mask[:, None], first.values, second.values),
            torch.where(mask[:, None, None], first.jacobian.mT, second.jacobian.mT).mT,
            torch.where(mask[:, None], first.cosines, second.cosines),
            first.scene_count,
            _where(mask[:, None], first.unobserved, second.unobserved),
            _where(mask, first.offset, second.offset),
        )


def residuals(surfaces: SurfacePair, T: Sim3, offset: Tensor | None = None) -> Residuals:
    """Both residuals of the batch of poses T (H,) at the samples of both surfaces, object units.

    offset: (H,), see :class:`Residuals`; None: the surfaces coincide.
    """
    pair = native_pair(surfaces, T)
    if pair is not None:
        rows, finite = pair.residuals((T.scale, T.rotation, T.translation), offset)
        if not finite:
            raise not_finite()
        values, jacobian, cosines, flags = rows
        assert values is not None
        assert jacobian is not None
        assert cosines is not None
        return Residuals(values, jacobian.mT, cosines, pair.scene_count, flags, offset)
    A, B = surfaces.scene_samples, surfaces.object_samples
    T = T.to(A.points)
    r1, J1, cosines1 = _scene_to_object(surfaces.obj, A, T, surfaces.ahead)
    r2, J2, cosines2, unobserved = _object_to_scene(surfaces.scene, B, T, A.unobserved)
    if offset is not None:
        r1, r2 = r1 - offset[:, None].to(r1), r2 + offset[:, None].to(r2)
    return Residuals(
        torch.cat([r1, r2], 1),
        torch.cat([J1, J2], 2).mT,
        torch.cat([cosines1, cosines2], 1),
        len(A),
        None if unobserved is None else torch.cat([_hidden(A, cosines1), unobserved], 1),
        offset,
    )


def native_pair(surfaces: SurfacePair, T: Sim3) -> compiled.Pair | None:
    """The surfaces for compiled code, at poses T; None: it does not work here."""
    A, B = surfaces.scene_samples, surfaces.object_samples
    poses = (part.float() for part in (T.scale, T.rotation, T.translation))
    parts = (A.points, A.values, A.normals, B.points, B.values, B.normals)
    steps, seen = compiled.steps_for(*parts, *poses), A.unobserved
    if steps is None or not (seen is None or isinstance(seen, WorkingObservation)):
        return None
    known = None if seen is None else seen.compiled()
    of_scene, of_object = ((one.points, one.values, one.normals) for one in (A, B))
    hidden = None if seen is None else A.hidden
    given = of_scene, of_object, surfaces.scene, surfaces.obj, known, hidden
    return compiled.Pair(steps, *given, surfaces.ahead, EVIDENCE.min_inlier_cosine)


def _scene_to_object(obj: DistanceModel, A: Samples, T: Sim3, ahead: float) -> tuple[Tensor, Tensor, Tensor]:
    s, R, t = T.scale[:, None], T.rotation, T.translation[..., None]
    arm = (s[..., None] * R) @ A.points.mT  # y - t, (H, 3, N)
    normals = R @ A.normals.mT
    if ahead:
        step = (ahead * s[..., None]) * normals
        value, g = _query(obj, arm + t + step)
        value = value.sub_(_dot(g, step))
    else:
        value, g = _query(obj, arm + t)
    own = s * A.values  # samples lie near the surface, not on it: the field's value there counts, in object units
    return value - own, _jacobian(arm, g, _dot(g, arm).sub_(value)), _cosine(g, normals)


def _object_to_scene(
    scene: DistanceModel, B: Samples, T: Sim3, unobserved: UnobservedTest | None
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    s, R, t = T.scale[:, None], T.rotation, T.translation[..., None]
    arm = B.points.mT - t  # z - t, (H, 3, M)
    w = (R.mT / s[..., None]) @ arm
    value, g = _query(scene, w)
    turned = R @ g  # R g_a
    scaled = s * value
    J = _jacobian(arm, -turned, B.values - _dot(turned, arm))  # of s d(r/s): no term from s S_a, see above
    r2 = scaled - B.values
    cosines = _cosine(turned, B.normals.mT)
    if unobserved is None:
        return r2, J, cosines, None
    places, fronts = _as_points(w), _as_points(R.mT @ B.normals.mT)
    hidden = unobserved.faces_unobserved(places, fronts).reshape(r2.shape) & (cosines < EVIDENCE.min_inlier_cosine)
    return r2, J, cosines, hidden | unobserved.unobserved(places, r2.reshape(-1)).reshape(r2.shape)


def _hidden(A: Samples, cosines: Tensor) -> Tensor:
    """(H, N) bool: which of the scene's samples no camera observed from their front, although the object faces another
    way."""
    if A.hidden is None:
        return torch.zeros_like(cosines, dtype=torch.bool)
    return A.hidden & (cosines < EVIDENCE.min_inlier_cosine)


def _query(model: DistanceModel, places: Tensor) -> tuple[Tensor, Tensor]:
    """Value (H, N) and gradient (H, 3, N) of the model at places (H, 3, N)."""
    poses, _, count = places.shape
    value, gradient = model.value_and_gradient(_as_points(places))
    return value.reshape(poses, count), gradient.reshape(poses, count, 3).mT.contiguous()


def _as_points(places: Tensor) -> Tensor:
    """(H, 3, N) as points (H N, 3)."""
    return places.mT.reshape(-1, 3)


def _jacobian(arm: Tensor, g: Tensor, lever: Tensor) -> Tensor:
    """[arm x g, g, lever], (H, 7, N), from (H, 3, N), (H, 3, N) and (H, N)."""
    # Written in place, plane by plane: a cross product along so short an axis, and a join, take several times as long.
    J = torch.empty(arm.shape[0], 7, arm.shape[2], dtype=arm.dtype, device=arm.device)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        torch.mul(arm[:, i], g[:, j], out=J[:, k]).addcmul_(arm[:, j], g[:, i], value=-1.0)
    J[:, 3:6] = g
    J[:, 6] = lever
    return J


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """(H, N), of vectors (..., 3, N): sums over so short an axis are slow, three products are not."""
    total = a[..., 0, :] * b[..., 0, :]
    total = total.addcmul_(a[..., 1, :], b[..., 1, :])
    return total.addcmul_(a[..., 2, :], b[..., 2, :])


def _cosine(gradient: Tensor, normals: Tensor) -> Tensor:
    return _dot(gradient, normals).div_(_dot(gradient, gradient).sqrt_().clamp_min_(1e-6))


def _where(mask: Tensor, first: Tensor | None, second: Tensor | None) -> Tensor | None:
    return None if first is None or second is None else torch.where(mask, first, second)


# The Geman-McClure kernel (Geman & McClure 1987), written once: loss, weight and curvature.
#
# With q = (r / c)^2 for a residual r and a kernel width c, in the same unit:
#
#     loss       q / (1 + q)                 0 at r = 0, 1/2 at one width, 1 far out
#     agreement  1 / (1 + q)                 1 - loss
#     weight     1 / (1 + q)^2               of r in iteratively reweighted least squares
#     curvature  weight (1 - 3 q) / (1 + q)  second derivative of the loss, times c^2 / 2
#
# All functions are elementwise; residuals and widths broadcast.


def geman_mcclure_loss(r: Tensor, width: Tensor | float) -> Tensor:
    """The loss, 0..1."""
    squares = r.square()
    return squares / (squares + width**2)


def geman_mcclure_agreement(r: Tensor, width: Tensor | float) -> Tensor:
    """1 - loss, 0..1."""
    return width**2 / (r.square() + width**2)


def geman_mcclure_weight(r: Tensor, width: Tensor | float) -> Tensor:
    """The weight of a residual in least squares, 0..1."""
    return geman_mcclure_agreement(r, width).square()


def geman_mcclure_curvature(r: Tensor, width: Tensor | float, weight: Tensor) -> Tensor:
    """The curvature, where ``weight`` is the kernel's weight, times any weight of the sample itself."""
    squares = (r / width).square()
    return weight * (1.0 - 3.0 * squares) / (1.0 + squares)

"""The two residuals of a pose and their derivatives with respect to a left perturbation (omega, dt, log-scale step).

With y = T x for scene points x, w = T^-1 z for object points z, g the fields' gradients:

    r1 = S_b(y) - s S_a(x)    dr1 = [ (y-t) x g_b,      g_b,    g_b . (y-t) - s S_a(x)         ]
    r2 = s S_a(w) - S_b(z)    dr2 = [ -(z-t) x (R g_a), -R g_a, s S_a(w) - (R g_a) . (z-t)     ]

Both vanish for all points, on the surface or off it, when S_b(T x) = s S_a(x): the scale is part of them.

Fields learned from images are too thick or too thin by much the same everywhere: the two surfaces are then an offset d
apart, S_b(T x) = s S_a(x) + d, and what vanishes is r1 - d and r2 + d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3


class DistanceModel(Protocol):
    """Anything that tells a signed distance (M,) and its gradient (M, 3) at points (M, 3)."""

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]: ...


class Unseen(Protocol):
    """Tells where nobody looked: (M,) bool for points (M, 3) of the samples' frame, signed distances (M,) there."""

    def __call__(self, points: Tensor, values: Tensor, /) -> Tensor: ...


@dataclass(frozen=True, eq=False)
class Samples:
    """Points near a surface: points (N, 3), the field's value there (N,), its unit normals (N, 3). float32, CPU.

    unseen: where the field rests on nothing; None: all was seen.
    """

    points: Tensor
    values: Tensor
    normals: Tensor
    unseen: Unseen | None = None

    def __len__(self) -> int:
        return int(self.points.shape[0])

    def __getitem__(self, index: Tensor) -> Samples:
        return Samples(self.points[index], self.values[index], self.normals[index], self.unseen)

    def on_surface(self) -> Tensor:
        """The points (N, 3) carried onto the surface along their normals."""
        return self.points - self.values.unsqueeze(-1) * self.normals


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals (H, N + M) of H poses, scene samples first; Jacobian (H, N + M, 7); agreement of the normals.

    ``cosines`` (H, N + M): cosine between a sample's normal and the other field's gradient where the pose carries it.
    unseen: (H, N + M) bool, object samples that come to lie where nobody looked into the scene; None: all was seen ·
    offset: (H,) how much farther out the scene's surface lies than the object's, object units; already taken out of
    the values.
    """

    values: Tensor
    jacobian: Tensor
    cosines: Tensor
    scene_count: int
    unseen: Tensor | None = None
    offset: Tensor | None = None

    def of(self, poses: Tensor) -> Residuals:
        """Those of some poses."""
        unseen = None if self.unseen is None else self.unseen[poses]
        offset = None if self.offset is None else self.offset[poses]
        return Residuals(
            self.values[poses], self.jacobian[poses], self.cosines[poses], self.scene_count, unseen, offset
        )


def residuals(
    scene: DistanceModel, obj: DistanceModel, A: Samples, B: Samples, T: Sim3, offset: Tensor | None = None
) -> Residuals:
    """Both residuals of the batch of poses T (H,) at scene samples A (N) and object samples B (M), object units.

    offset: (H,), see :class:`Residuals`; None: the surfaces coincide.
    """
    T = T.to(A.points)
    s, R, t = T.scale[:, None], T.rotation, T.translation[:, None]
    forth, J_forth, cos_forth = _scene_to_object(obj, A, s, R, t)
    back, J_back, cos_back, unseen = _object_to_scene(scene, B, s, R, t, A.unseen)
    if offset is not None:
        forth, back = forth - offset[:, None].to(forth), back + offset[:, None].to(back)
    return Residuals(
        torch.cat([forth, back], 1),
        torch.cat([J_forth, J_back], 1),
        torch.cat([cos_forth, cos_back], 1),
        len(A),
        None if unseen is None else torch.cat([torch.zeros_like(forth, dtype=torch.bool), unseen], 1),
        offset,
    )


def _scene_to_object(obj: DistanceModel, A: Samples, s: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    arm = s[..., None] * (A.points @ R.mT)  # y - t, (H, N, 3)
    value, g = _ask(obj, arm + t)
    own = s * A.values
    lever = (g * arm).sum(-1) - own
    J = torch.cat([torch.linalg.cross(arm, g), g, lever[..., None]], dim=-1)
    return value - own, J, _cosine(g, A.normals @ R.mT)


def _object_to_scene(
    scene: DistanceModel, B: Samples, s: Tensor, R: Tensor, t: Tensor, unseen: Unseen | None
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    arm = B.points - t  # z - t, (H, M, 3)
    w = (arm @ R) / s[..., None]
    value, g = _ask(scene, w)
    turned = g @ R.mT  # R g_a
    seen = s * value
    lever = seen - (turned * arm).sum(-1)
    J = torch.cat([-torch.linalg.cross(arm, turned), -turned, lever[..., None]], dim=-1)
    residual = seen - B.values
    hidden = None if unseen is None else unseen(w.reshape(-1, 3), residual.reshape(-1)).reshape(residual.shape)
    return residual, J, _cosine(turned, B.normals.expand_as(turned)), hidden


def _ask(model: DistanceModel, points: Tensor) -> tuple[Tensor, Tensor]:
    value, gradient = model.value_and_gradient(points.reshape(-1, 3))
    return value.reshape(points.shape[:-1]), gradient.reshape(points.shape)


def _cosine(gradient: Tensor, normals: Tensor) -> Tensor:
    cosine: Tensor = (gradient * normals).sum(-1) / gradient.norm(dim=-1).clamp_min(1e-6)
    return cosine

"""What the held-out samples tell of poses, as numbers without units: the input of the probability model.

Lengths are in object diameters, shares within 0 and 1. Each number has one direction: more of it speaks for the pose,
or against it (``SPEAKS_FOR``). What was hidden from the cameras is left out of what is compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.residuals import Residuals
from regnf_core.robust.verdict.coverage import coverage
from regnf_core.robust.verdict.unexplained_surface import unexplained_samples

SPEAKS_FOR = {
    "object_agrees": True,
    "object_agrees_coarsely": True,
    "scene_agrees": True,
    "scene_agrees_coarsely": True,
    "hull_explained": True,
    "confirmed": True,
    "confirmed_patches": True,
    "covered_patches": True,
    "normals_agree_object": True,
    "normals_agree_scene": True,
    "stiffness": True,
    "second_stiffness": True,
    "seen_through": False,
    "free": False,
    "matter_inside": False,
    "unexplained": False,
    "hidden": False,
    "noise": False,
    "tail": False,
    "offset": False,
}
"""The features by name: whether more of it makes the pose more likely (True) or less (False)."""


@dataclass(frozen=True, eq=False)
class _Groups:
    """Which samples (H, N) or (H, M) belong to what: those of the scene near the object and those that agree there; of
    the object's those that are visible, observed, in agreement, and in agreement with the normal that the scene has."""

    near: Tensor
    scene_agrees: Tensor
    visible: Tensor
    observed: Tensor
    object_agrees: Tensor
    confirmed: Tensor


def pose_features(problem: RegistrationProblem, T: Sim3, r: Residuals, offsets: Tensor) -> dict[str, Tensor]:
    """Each feature (H,) float64 of the poses T (H,) between the working frames, by name, where the problem is.

    r: of the held-out samples under these poses · offsets: (H,) of the surfaces, as the residuals have them.
    """
    groups = _groups(r)
    found = _agreement(r, groups) | _conflict(problem, T, r, groups) | _normals(r, groups) | _spread(r, groups)
    found |= _coverage(problem, T, groups) | {"offset": offsets.abs()}
    stiffness = _stiffness(problem, T, r, groups)
    found |= {"stiffness": stiffness[:, 0], "second_stiffness": stiffness[:, 1]}
    return {name: found[name].double() for name in SPEAKS_FOR}


def _groups(r: Residuals) -> _Groups:
    r1, r2, n = r.scene_to_object, r.object_to_scene, r.scene_count
    near = r1.abs() <= EVIDENCE.near
    seen = torch.ones_like(r.values, dtype=torch.bool) if r.unobserved is None else ~r.unobserved
    near, observed = near & seen[:, :n], seen[:, n:]
    agrees = r2.abs() <= EVIDENCE.agreement
    visible = observed & (agrees | (r2 > 0))
    agrees &= observed
    confirmed = agrees & (r.cosines[:, n:] >= EVIDENCE.min_inlier_cosine)
    return _Groups(near, near & (r1.abs() <= EVIDENCE.agreement), visible, observed, agrees, confirmed)


def _agreement(r: Residuals, groups: _Groups) -> dict[str, Tensor]:
    """Shares of what was seen of both surfaces that agrees, at two distances."""
    r1, r2 = r.scene_to_object.abs(), r.object_to_scene.abs()
    close, far = EVIDENCE.close, EVIDENCE.coarse
    return {
        "object_agrees": _share((r2 <= close) & groups.visible, groups.visible),
        "object_agrees_coarsely": _share((r2 <= far) & groups.visible, groups.visible),
        "scene_agrees": _share((r1 <= close) & groups.near, groups.near),
        "scene_agrees_coarsely": _share((r1 <= far) & groups.near, groups.near),
        "confirmed": groups.confirmed.double().mean(1),
        "hidden": (~groups.visible).double().mean(1),
    }


def _conflict(problem: RegistrationProblem, T: Sim3, r: Residuals, groups: _Groups) -> dict[str, Tensor]:
    """What the object leaves open within its hull, and where it stands in free space or within matter."""
    A, r1, r2 = problem.held_out.scene_samples, r.scene_to_object, r.object_to_scene
    moved = T.to(A.points)
    within = problem.model.hull.contains(moved.apply(A.points), EVIDENCE.hull_margin)
    beyond = within & groups.near & (r1 > EVIDENCE.agreement)
    unexplained = unexplained_samples(problem.held_out, moved, beyond)
    free = groups.observed & (r2 > EVIDENCE.coarse)
    seen_through = free
    if problem.view.observation is not None:
        places = moved.inverse().apply(problem.held_out.object_samples.points)
        measured = problem.view.observation.on_surface(places.reshape(-1, 3)).reshape(r2.shape)
        seen_through = groups.observed & ~measured & (r2 > EVIDENCE.close)
    return {
        "hull_explained": _share(within & (r1.abs() <= EVIDENCE.agreement), within, of_nothing=1.0),
        "unexplained": _share(unexplained, groups.near),
        "matter_inside": _share(groups.near & (r1 < -EVIDENCE.agreement), groups.near),
        "free": _share(free, groups.visible),
        "seen_through": _share(seen_through, groups.visible),
    }


def _coverage(problem: RegistrationProblem, T: Sim3, groups: _Groups) -> dict[str, Tensor]:
    """Shares of the patches about the object's outermost points that are confirmed, and that scene surface is near."""
    A, B = problem.held_out.scene_samples.points, problem.held_out.object_samples.points
    return coverage(problem.model.extremal_points, B, T.to(A).apply(A), groups.confirmed, groups.near)


def _normals(r: Residuals, groups: _Groups) -> dict[str, Tensor]:
    """Mean cosines between the normals where the surfaces agree."""
    n = r.scene_count
    return {
        "normals_agree_scene": _mean(r.cosines[:, :n], groups.scene_agrees),
        "normals_agree_object": _mean(r.cosines[:, n:], groups.object_agrees),
    }


def _spread(r: Residuals, groups: _Groups) -> dict[str, Tensor]:
    """Root mean square of the residuals where the surfaces agree, and how long the tail of all that was seen is."""
    agree = torch.cat([groups.scene_agrees, groups.object_agrees], 1)
    seen = torch.cat([groups.near, groups.visible], 1)
    size = torch.where(seen, r.values.abs(), torch.nan)
    core, tail = torch.nanquantile(size, size.new_tensor(EVIDENCE.tail_quantiles), dim=1).nan_to_num(1.0)
    return {
        "noise": _mean(r.values.square(), agree, of_nothing=EVIDENCE.agreement**2).sqrt(),
        "tail": (tail / core.clamp_min(EVIDENCE.min_core)).log(),
    }


def _stiffness(problem: RegistrationProblem, T: Sim3, r: Residuals, groups: _Groups) -> Tensor:
    """(H, 2): the two least root mean square residuals of the surfaces that agree when the object's surface moves by a
    root mean square of 1, over all similarity motions. 0: the agreement leaves a motion free."""
    m = r.values.shape[1] - r.scene_count
    weights = torch.cat(
        [groups.scene_agrees / groups.near.sum(1, keepdim=True).clamp_min(1), groups.object_agrees / m], 1
    )
    J = _about_origin(r.jacobian.double(), T.translation.double()[:, None])
    H = 0.5 * (J * weights.double()[..., None]).mT @ J
    points = problem.held_out.object_samples.points.double()
    eye = torch.eye(7, dtype=points.dtype, device=points.device)
    motion = torch.cat([_cross_matrix(points).mT, eye[:3, :3].expand(m, 3, 3), points[..., None]], -1)
    G = (motion.mT @ motion).mean(0)
    inverse = torch.linalg.inv(torch.linalg.cholesky(G + 1e-9 * eye))
    least: Tensor = torch.linalg.eigvalsh(inverse @ H @ inverse.mT)[:, :2]
    return least.clamp_min(0.0).sqrt()


def _about_origin(J: Tensor, t: Tensor) -> Tensor:
    """The Jacobian (H, K, 7) for turns and growth about the object's center instead of about the pose's translation t
    (H, 1, 3): what moves the object's surface is then well conditioned, however far away the scene's origin is."""
    shift = J[..., 3:6]
    turn = J[..., :3] + torch.linalg.cross(t.expand_as(shift), shift)
    growth = J[..., 6:] + (t * shift).sum(-1, keepdim=True)
    return torch.cat([turn, shift, growth], -1)


def _cross_matrix(v: Tensor) -> Tensor:
    """(..., 3, 3): what gives the cross product v x w when applied to w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape, 3)


def _share(part: Tensor, whole: Tensor, of_nothing: float = 0.0) -> Tensor:
    """(H,): how many of ``whole`` (H, N) are ``part``."""
    count = whole.sum(1)
    return torch.where(count > 0, part.sum(1) / count.clamp_min(1), of_nothing)


def _mean(values: Tensor, mask: Tensor, of_nothing: float = 0.0) -> Tensor:
    """(H,): mean of the values (H, N) where the mask is set."""
    count = mask.sum(1)
    total = torch.where(mask, values, 0.0).sum(1)
    return torch.where(count > 0, total / count.clamp_min(1), of_nothing)

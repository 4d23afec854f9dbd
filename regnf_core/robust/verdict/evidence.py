"""What the held-out samples tell of poses, in numbers; ``criteria`` makes a verdict of them.

Both directions count: how much of the object's surface the scene confirms, and how much of the scene's surface the
object explains. Where the scene is free although the object should be there, the pose is wrong. Where the scene has
matter instead, the part may be occluded (fields are solid behind what was observed), and it does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.metrics import NearestNeighbors
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import RobustOptions
from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.problem import RegistrationProblem
from regnf_core.robust.refine.loss import disagreement
from regnf_core.robust.residuals import Residuals, SurfacePair
from regnf_core.surface.result_clouds import newton_step


@dataclass(frozen=True, eq=False)
class Evidence(Bundle):
    """Evidence of the verification samples for H poses: shares 0..1, lengths in object diameters.

    numbers: each (H,), by the names that results carry; docs/reference/metrics.md says what they are · scene_signs:
    (H, N) and object_signs: (H, M) uint8, see :class:`regnf_core.document.Considered` · partial: part of the scene is
    known not to have been observed; that part is left out, the rest was measured.
    """

    numbers: dict[str, Tensor]
    scene_signs: Tensor
    object_signs: Tensor
    partial: bool = False


@dataclass(frozen=True, eq=False)
class HeldOut(Bundle):
    """Evidence of the verification samples for H poses, on the CPU: the complete basis of a verdict. The fields are
    evaluated once.

    features: each (H,), by its name, see `pose_features` · admitted: (H,) bool, which of the poses the detection
    allows.
    """

    evidence: Evidence
    features: dict[str, Tensor]
    admitted: Tensor

    def of(self, index: int) -> dict[str, float]:
        """The numbers of one pose, by the names that results carry."""
        told = self.evidence.numbers | {"unexplained_share_scene": self.features["unexplained"]}
        return {name: float(values.numpy()[index]) for name, values in told.items()}


def gather_evidence(r: Residuals, offsets: Tensor, options: RobustOptions) -> Evidence:
    """The evidence of the residuals of the verification samples under H poses. offsets: (H,), as the residuals have
    them."""
    n, limit = r.scene_count, options.inlier_distance
    to_scene = r.object_to_scene
    inlier = (r.values.abs() <= limit) & (r.cosines >= EVIDENCE.min_inlier_cosine)
    observed = torch.ones_like(to_scene, dtype=torch.bool) if r.unobserved is None else ~r.unobserved[:, n:]
    # An object sample within the scene's matter, or where no camera looked, is hidden: fields are solid behind
    # surfaces.
    occluded = (~observed | (to_scene < -limit)) & ~inlier[:, n:]
    visible = (~occluded).sum(1).clamp_min(1)
    near = r.scene_to_object.abs() <= EVIDENCE.near
    if r.unobserved is not None:
        near &= ~r.unobserved[:, :n]
    free = (to_scene > limit) & observed
    squares = torch.where(inlier, r.values.square(), 0.0).sum(1)
    numbers = {
        "score": disagreement(r, EVIDENCE.score_width),
        "inlier_share_object": inlier[:, n:].sum(1) / visible,
        "inlier_share_scene": inlier[:, :n].sum(1) / near.sum(1).clamp_min(1),
        "explained_share_scene": inlier[:, :n].float().mean(1),
        "occluded_share_object": occluded.float().mean(1),
        "free_space_violations": free.sum(1) / visible,
        "residual_rms": (squares / inlier.sum(1).clamp_min(1)).sqrt(),
        "coarse_agreement": _coarse(r, near, observed, EVIDENCE.coarse_distance * limit),
        "surface_offset": offsets,
    }
    scene_signs = _signs((~inlier[:, :n] & near, 1), (~inlier[:, :n] & ~near, 2))
    object_signs = _signs((~inlier[:, n:], 3), (occluded, 2), (free, 1))
    return Evidence(numbers, scene_signs, object_signs, r.unobserved is not None)


def _signs(*marked: tuple[Tensor, int]) -> Tensor:
    """(H, N) uint8: the number of the last that marks each sample; 0 where none does."""
    signs = torch.zeros_like(marked[0][0], dtype=torch.uint8)
    for where, number in marked:
        signs.masked_fill_(where, number)
    return signs


def _coarse(r: Residuals, near: Tensor, observed: Tensor, distance: float) -> Tensor:
    """(H,): the share of samples, the smaller one of both directions, that agree at this distance, whatever the
    normals, minus the share in free space. near: (H, N) scene samples · observed: (H, M) object samples."""
    to_scene = r.object_to_scene
    explained = r.scene_to_object.abs() <= distance
    of_near = explained.sum(1) / near.sum(1).clamp_min(1)
    of_object = (observed & (to_scene.abs() <= distance)).sum(1) / observed.sum(1).clamp_min(1)
    free = (observed & (to_scene > distance)).sum(1) / (observed & (to_scene >= -distance)).sum(1).clamp_min(1)
    agreement: Tensor = torch.minimum(of_near, of_object) - free
    return agreement


# Coverage: how much of the object matches, by patches of its surface instead of all samples together.
#
# Another object, or the right one in a wrong place, agrees with the scene where the two are alike and not elsewhere.
# A share of all samples does not tell that from errors that are spread over the whole object.


def coverage(
    centers: Tensor, object_points: Tensor, scene_points: Tensor, confirmed: Tensor, near: Tensor
) -> dict[str, Tensor]:
    """Shares (H,) of the object's patches, by name, for H poses.

    centers: (K, 3), of the patches, of which each has what is nearest to it · object_points: (M, 3) · scene_points:
    (H, N, 3), as the poses place them · all in the object's frame. confirmed: (H, M) bool, object samples that agree
    with the scene · near: (H, N) bool, scene samples near the object.

    ``confirmed_patches``: patches of which enough samples are confirmed · ``covered_patches``: patches with scene
    surface near them.
    """
    mine = _nearest(object_points, centers).expand(confirmed.shape)
    size = _count(torch.ones_like(confirmed), mine, len(centers))
    agreeing = _count(confirmed, mine, len(centers))
    seen = _count(near, _nearest(scene_points, centers), len(centers))
    return {
        "confirmed_patches": (agreeing >= EVIDENCE.min_confirmed_in_patch * size).double().mean(1),
        "covered_patches": (seen >= EVIDENCE.min_samples_in_patch).double().mean(1),
    }


def _nearest(points: Tensor, centers: Tensor) -> Tensor:
    """(...): the number of the center (K, 3) that each of the points (..., 3) is nearest to."""
    return torch.stack([(points - center).square().sum(-1) for center in centers]).argmin(0)


def _count(mask: Tensor, patch: Tensor, patches: int) -> Tensor:
    """(H, K): how many of the samples that ``mask`` (H, N) names belong to each patch; patch: (H, N), their numbers."""
    counts = torch.zeros(len(mask), patches, dtype=torch.long, device=mask.device)
    return counts.scatter_add_(1, patch, mask.long())


# Surface of the scene within the object's hull that is no part of it: a cushion on a chair that should have none.
#
# What stands close by, lies on top or carries the object touches it from outside of its convex hull: it says nothing
# against the object. Within the hull, another object's surface may stand too (a chair under a table), but it faces
# the object's own surface, which the scene shows as well. What lies on the object covers the object's surface, or its
# own surface faces away from it.


def unexplained_samples(held_out: SurfacePair, T: Sim3, beyond: Tensor) -> Tensor:
    """(H, N) bool: which scene samples are unexplained at poses T (H,) between the working frames.

    beyond: (H, N) bool, samples outside of the object's surface, within its hull. They are unexplained unless they face
    that surface and the scene shows it.
    """
    A = held_out.scene_samples
    pose, sample = beyond.nonzero(as_tuple=True)
    unexplained = torch.zeros_like(beyond)
    if len(pose) == 0:
        return unexplained
    T = T.to(A.points)[pose]
    places = T.apply(A.points[sample][:, None])[:, 0]
    value, gradient = held_out.obj.value_and_gradient(places)
    slope = gradient.square().sum(-1).clamp_min(EVIDENCE.min_slope**2).sqrt()
    turned = (T.rotation @ A.normals[sample][..., None])[..., 0]
    away = (turned * gradient).sum(-1) >= EVIDENCE.facing_cosine * slope
    beneath = places - newton_step(value, gradient, EVIDENCE.min_slope)
    unexplained[pose, sample] = away | _covered(held_out, T, T.apply_inverse(beneath[:, None])[:, 0])
    return unexplained


def _covered(held_out: SurfacePair, T: Sim3, points: Tensor) -> Tensor:
    """(K,) bool: points (K, 3) of the scene's working frame that lie within matter, or were not observed."""
    value, _ = held_out.scene.value_and_gradient(points)
    value = T.scale * value
    covered: Tensor = value < -EVIDENCE.close
    unobserved = held_out.scene_samples.unobserved
    return covered if unobserved is None else covered | unobserved.unobserved(points, value)


# What the held-out samples tell of poses, as numbers without units: the input of the probability model.
#
# Lengths are in object diameters, shares within 0 and 1. Each number has one direction: more of it speaks for the
# pose, or against it (``SPEAKS_FOR``). What was hidden from the cameras is left out of what is compared.

SPEAKS_FOR = {
    "object_agrees": True,
    "object_agrees_coarsely": True,
    "scene_agrees": True,
    "scene_agrees_coarsely": True,
    "hull_explained": True,
    "confirmed": True,
    "confirmed_patches": True,
    "covered_patches": True,
    "worst_of_object": False,
    "worst_of_scene": False,
    "worst_normals": False,
    "excess_of_object": False,
    "excess_of_scene": False,
    "stretch": False,
    "normals_agree_object": True,
    "normals_agree_scene": True,
    "stiffness": True,
    "second_stiffness": True,
    "seen_through": False,
    "free": False,
    "matter_inside": False,
    "unexplained": False,
    "unexplained_beyond_noise": False,
    "attached": False,
    "worst_attached": False,
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
    A, B, n = problem.held_out.scene_samples.points, problem.held_out.object_samples.points, r.scene_count
    placed = T.to(A).apply(A)
    within = problem.model.hull.contains(placed, EVIDENCE.hull_margin)
    found = _agreement(r, groups) | _conflict(problem, T, r, groups, within) | _spread(r, groups)
    found |= coverage(problem.model.extremal_points, B, placed, groups.confirmed, groups.near)
    found |= _worst(problem, r, groups, within)
    stiffness = _stiffness(problem, T, r, groups)
    found |= {
        "normals_agree_scene": _mean(r.cosines[:, :n], groups.scene_agrees),
        "normals_agree_object": _mean(r.cosines[:, n:], groups.object_agrees),
        "stiffness": stiffness[:, 0],
        "second_stiffness": stiffness[:, 1],
        "offset": offsets.abs(),
        "stretch": _stretch(problem, T, r, groups, found["noise"]),
    }
    # The same disagreement tells more where the surfaces agree closely elsewhere.
    usual = (found["noise"] + 2.0 * EVIDENCE.min_core) / EVIDENCE.coarse
    found |= {f"excess_of_{side}": found[f"worst_of_{side}"] / usual for side in ("object", "scene")}
    inlier = (r.values.abs() <= EVIDENCE.score_width) & torch.cat([groups.near, groups.visible], 1)
    closely = _mean(r.values.square(), inlier, of_nothing=EVIDENCE.score_width**2).sqrt()
    allowed = EVIDENCE.unexplained + EVIDENCE.unexplained_per_noise * closely
    found["unexplained_beyond_noise"] = (found["unexplained"] - allowed).clamp_min(0.0)
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
    """Shares of the observed parts of both surfaces that match, at two distances."""
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


def _conflict(
    problem: RegistrationProblem, T: Sim3, r: Residuals, groups: _Groups, within: Tensor
) -> dict[str, Tensor]:
    """What the object leaves open within its hull, and where it stands in free space or within matter. within: (H, N)
    bool, which scene samples lie within the hull."""
    r1, r2 = r.scene_to_object, r.object_to_scene
    moved = T.to(problem.held_out.scene_samples.points)
    beyond = groups.near & (r1 > EVIDENCE.agreement)
    unexplained = unexplained_samples(problem.held_out, moved, beyond)
    attached = unexplained & ~within
    of_scene = _neighbors(problem.held_out.scene_samples.points)
    free = groups.observed & (r2 > EVIDENCE.coarse)
    seen_through = free
    if problem.view.observation is not None:
        places = moved.apply_inverse(problem.held_out.object_samples.points)
        measured = problem.view.observation.on_surface(places.reshape(-1, 3)).reshape(r2.shape)
        seen_through = groups.observed & ~measured & (r2 > EVIDENCE.close)
    return {
        "hull_explained": _share(within & (r1.abs() <= EVIDENCE.agreement), within, of_nothing=1.0),
        "unexplained": _share(unexplained & within, groups.near),
        "attached": _share(attached, groups.near),
        "worst_attached": worst_place(attached.to(r1), groups.near, of_scene),
        "matter_inside": _share(groups.near & (r1 < -EVIDENCE.agreement), groups.near),
        "free": _share(free, groups.visible),
        "seen_through": _share(seen_through, groups.visible),
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


# Where the surfaces disagree most. Another object agrees in most places, and nowhere in a few; errors of the right one
# are spread. A share of all samples does not tell the two apart, the mean over a sample's neighbors does.


def _worst(problem: RegistrationProblem, r: Residuals, groups: _Groups, within: Tensor) -> dict[str, Tensor]:
    """How far the surfaces disagree, 0..1, at the places where they do most: the object's visible samples, the scene's
    within the object's hull, and the object's by the normals. within: as of `_conflict`."""
    n = r.scene_count
    of_scene = _neighbors(problem.held_out.scene_samples.points)
    of_object = _neighbors(problem.held_out.object_samples.points)
    r1, r2 = ((one.abs() / EVIDENCE.coarse).clamp_max(1.0) for one in (r.scene_to_object, r.object_to_scene))
    turned = (r.cosines[:, n:] < EVIDENCE.min_inlier_cosine).to(r2)
    return {
        "worst_of_object": worst_place(r2, groups.visible, of_object),
        "worst_of_scene": worst_place(r1, within & groups.near, of_scene),
        "worst_normals": worst_place(turned, groups.visible, of_object),
    }


def _neighbors(points: Tensor) -> Tensor:
    """(N, K): the nearest of the points (N, 3) to each, itself among them."""
    return NearestNeighbors(points).query_several(points, EVIDENCE.place_samples)[1]


def worst_place(
    values: Tensor,
    counts: Tensor,
    neighbors: Tensor,
    least: int = EVIDENCE.least_in_place,
    quantile: float = EVIDENCE.worst_quantile,
) -> Tensor:
    """(H,): a high quantile of the means of the values (H, N) over the neighbors (N, K) that count (H, N), where at
    least so many do."""
    weight = counts.to(values)
    beside = weight[:, neighbors].sum(-1)
    mean = (values * weight)[:, neighbors].sum(-1) / beside.clamp_min(1.0)
    mean = torch.where(counts & (beside >= least), mean, 0.0)
    return mean.quantile(quantile, dim=1)


# By how much another shape would fit better: one that is longer along some axis, or sheared.


def _stretch(problem: RegistrationProblem, T: Sim3, r: Residuals, groups: _Groups, noise: Tensor) -> Tensor:
    """(H,): largest less least stretch of the affine motion that fits the samples best, besides
    the pose. Least squares about the pose, with weights that forgive (Geman and McClure), and a prior for no stretch:
    what nobody saw is not stretched.

    r moves by g . (E p + v) under a strain E and a motion v of the object's surface, with the gradients g: the columns
    of the Jacobian for shifts.
    """
    A, B, n = problem.held_out.scene_samples.points, problem.held_out.object_samples.points, r.scene_count
    places = torch.cat([T.to(A).apply(A), B.expand(len(T), -1, -1)], 1).double()
    gradient = torch.nn.functional.normalize(r.jacobian[..., 3:6].double(), dim=-1)
    values, seen = r.values.double(), torch.cat([groups.near, groups.visible], 1)
    width = EVIDENCE.stretch_width * noise.double().clamp_min(EVIDENCE.min_core)[:, None]
    weight = seen / (1.0 + (values / width).square()).square()
    weight = torch.cat([weight[:, :n] / groups.near.sum(1, keepdim=True).clamp_min(1),
                        weight[:, n:] / groups.visible.sum(1, keepdim=True).clamp_min(1)], 1)  # fmt: skip
    outer = gradient[..., :, None] * places[..., None, :]
    strain = torch.stack([outer[..., i, j] + (outer[..., j, i] if i != j else 0.0) for i, j in _STRAINS], -1)
    J = torch.cat([strain, torch.linalg.cross(places, gradient), gradient], -1)
    weighted = J * (weight / weight.sum(1, keepdim=True).clamp_min(1e-9))[..., None]
    variance = (weight * values.square()).sum(1) / weight.sum(1).clamp_min(1e-9) + EVIDENCE.min_core**2
    prior = torch.diag(J.new_tensor([EVIDENCE.usual_stretch**-2] * 6 + [1e-6] * 6)) / EVIDENCE.stretch_samples
    H = weighted.mT @ J + variance[:, None, None] * prior
    step = torch.linalg.solve(H, -(weighted.mT @ values[..., None]))[..., 0]
    E = step.new_zeros(len(step), 3, 3)
    for number, (i, j) in enumerate(_STRAINS):
        E[:, i, j] = E[:, j, i] = step[:, number]
    least, _, most = torch.linalg.eigvalsh(E).unbind(-1)
    stretch: Tensor = most - least
    return stretch


_STRAINS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


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
    motion = torch.cat([skew(points).mT, eye[:3, :3].expand(m, 3, 3), points[..., None]], -1)
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


def _share(part: Tensor, whole: Tensor, of_nothing: float = 0.0) -> Tensor:
    """(H,): how many of ``whole`` (H, N) are ``part``."""
    count = whole.sum(1)
    return torch.where(count > 0, part.sum(1) / count.clamp_min(1), of_nothing)


def _mean(values: Tensor, mask: Tensor, of_nothing: float = 0.0) -> Tensor:
    """(H,): mean of the values (H, N) where the mask is set."""
    count = mask.sum(1)
    total = torch.where(mask, values, 0.0).sum(1)
    return torch.where(count > 0, total / count.clamp_min(1), of_nothing)

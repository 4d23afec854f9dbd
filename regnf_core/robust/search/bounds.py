"""What the caller knows of the scale: the scale factors that a pose may have."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.exponential_map import matrix_from_quaternion
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import Axis, RegistrationOptions, RobustOptions
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.residuals import geman_mcclure_loss
from regnf_core.surface.sphere_tracing import axis_vector


@dataclass(frozen=True)
class ScaleBound:
    """The scales s of poses x -> s R x + t between two frames: low <= s <= high; 0 and infinite: not known."""

    low: float = 0.0
    high: float = math.inf

    @classmethod
    def of(cls, options: RobustOptions, scene_length: float, object_length: float) -> ScaleBound:
        """The options' bound between the working frames. lengths: of the working frames' units, fields' units."""
        unit = scene_length / object_length
        low, high = options.scale_range
        return cls(0.0 if low is None else low * unit, math.inf if high is None else high * unit)

    @property
    def is_open(self) -> bool:
        """Whether every scale is allowed."""
        return self.low == 0.0 and self.high == math.inf

    @property
    def log_width(self) -> float:
        """The logarithm of the largest scale that is allowed over the smallest."""
        return math.log(self.high / self.low) if self.low > 0.0 else math.inf

    def limited_growth(self, scale: Tensor, growth: Tensor) -> Tensor:
        """The changes of log ``scale`` (H,), an allowed one, nearest to ``growth`` (H,) that lead to an allowed one."""
        low, high = (torch.full_like(scale, end).div_(scale).log_() for end in (self.low, self.high))
        return torch.minimum(torch.maximum(growth, low), high)

    def limited_poses(self, T: Sim3) -> Sim3:
        """Poses T (H,) with the nearest allowed scales; the object's center, 0, stays where it is in the scene."""
        if self.is_open:
            return T
        scale = T.scale.clamp(self.low, self.high)
        return replace(T, scale=scale, translation=T.translation * (scale / T.scale)[..., None])


ANY_SCALE = ScaleBound()
SAME_SCALE = ScaleBound(1.0, 1.0)


# What is known of a pose: the object stands within the box, give or take, is not far smaller than it, and its scale
# is within the caller's bounds.


@dataclass(frozen=True, eq=False)
class PoseBound(Bundle):
    """Bounds the extent of the posed object by the detection box, and its scale. Working frames: the box's center is 0.

    points: (E, 3) outermost points of the object · axes: (3, 3) the box's, columns, scene frame · edges: (3,) of the
    box · tolerance: how far the object may reach beyond each of the box's faces, as a share of the edge. The edges of
    flat boxes count as SEARCH.min_face_distance there: a flat thing's field may be much thicker than its box ·
    scale: what the caller knows of it · up_axis: the vertical axis of both frames; None: any pose may be toppled ·
    seen: the box is of what an image shows of the object: other things may hide
    the rest, so the object may reach beyond by its own extent too, and nothing is said of where it ends.
    """

    points: Tensor
    axes: Tensor
    edges: Tensor
    tolerance: float
    scale: ScaleBound = ANY_SCALE
    seen: bool = False
    up_axis: Axis | None = None

    @classmethod
    def of(
        cls, detection: OrientedBox, extremal_points: Tensor, tolerance: float, scale: ScaleBound = ANY_SCALE
    ) -> PoseBound:
        """The bound for an object with these ``extremal_points`` (E, 3), on their device."""
        axes, edges = detection.rotation.double(), (detection.size / detection.diagonal).double()
        device = extremal_points.device
        return cls(extremal_points.double(), axes.to(device), edges.to(device), tolerance, scale)

    def admits(self, T: Sim3) -> Tensor:
        """(H,) bool: which poses T (H,), scene to object, the detection allows."""
        return self.judged(T)[0]

    def judged(self, T: Sim3) -> tuple[Tensor, Tensor]:
        """(H,) bool: which poses T (H,) the detection allows; and (H,): how badly the posed object fills the box, as a
        score: a Geman-McClure loss over the box's six faces."""
        placed = T.apply_inverse(self.points) @ self.axes  # (H, E, 3)
        low, high = placed.amin(-2), placed.amax(-2)
        lengths, size = self._lengths, high - low
        beyond = torch.maximum(lengths, size) if self.seen else lengths
        reach = self.edges / 2 + self.tolerance * beyond
        within = (torch.maximum(-low, high) <= reach).all(-1)  # the box's center is 0
        admitted = within & ((size / lengths).amax(-1) >= SEARCH.min_share_of_detection)
        if self.up_axis is not None:
            up = axis_vector(self.up_axis).to(T.rotation.device)
            admitted &= (T.rotation.double() @ up) @ up >= SEARCH.min_upright_cosine
        if self.seen:
            return admitted, torch.zeros_like(T.scale)
        off = torch.cat([low + self.edges / 2, high - self.edges / 2], -1) / lengths.repeat(2)
        return admitted, SEARCH.box_weight * geman_mcclure_loss(off, SEARCH.box_width).mean(-1)

    @property
    def _lengths(self) -> Tensor:
        """(3,): what distances from the faces are compared with."""
        return self.edges.clamp_min(SEARCH.min_face_distance)

    def loosened(self, factor: float) -> PoseBound:
        """The bound with ``factor`` times the tolerance."""
        return replace(self, tolerance=factor * self.tolerance)


# Seeds for the search: rotations from a fixed, even set; scale and translation for each from the two shapes.
#
# There are three ways to scale and move a rotated object onto the surface in the box, because each fails in some
# cases: the centroids and root mean square radii (wrong with clutter), the extents of the points (wrong with one
# stray point), the detection box itself (wrong when it is loose).

_POINTS_AT_ONCE = 4 * 2**20
"""Turned points: bounds memory, at about 200 MB. The default options stay far below."""


def seed_poses(
    scene_points: Tensor,
    object_points: Tensor,
    box_axes: Tensor,
    box_size: Tensor,
    rotations: Tensor,
    scales: Tensor,
    bound: ScaleBound = ANY_SCALE,
) -> Sim3:
    """Poses T_object_scene (H,), working frames, float64: every rotation (K, 3, 3) with every way to scale and move.

    scene_points (N, 3): what may be the object, the box's center at 0 · box_axes (3, 3): columns, scene frame ·
    box_size (3,): full edges · scales: factors (L,) tried about the ratio of the radii · bound: of the scale.
    """
    scene_points, object_points = scene_points.double(), object_points.double()
    by_moments = _from_moments(scene_points, object_points, rotations, scales, bound)
    local = scene_points @ box_axes
    lowest, highest = local.amin(0, keepdim=True), local.amax(0, keepdim=True)
    low, high = _object_extents(object_points, rotations, box_axes)
    by_points = _from_extents(rotations, box_axes, (low, high), (lowest, highest))
    by_box = _from_extents(rotations, box_axes, (low, high), (-box_size[None] / 2, box_size[None] / 2))
    return Sim3.cat([by_moments, bound.limited_poses(by_points), bound.limited_poses(by_box)])


def seen_seeds(scene: Tensor, points: Tensor, normals: Tensor, axes: Tensor, rotations: Tensor, scale: float) -> Sim3:
    """Poses T_object_scene (6K,), as those of ``seed_poses``, of an object of known scale that one image shows.

    Its side that faces the camera is placed on the observed surface: for every rotation by the middle of that side, and
    by its
    nearest point and, across, the middles or the ends to one of four sides: what hides a part of the object hides it on
    one side. scene: (N, 3) · points, normals: (M, 3) of the object · axes: (3, 3), columns, the camera's, the last one
    away from it.
    """
    scene, points, axes = scene.double(), points.double(), axes.double()
    turned = rotations @ axes  # (K, 3, 3): the camera's axes in the object's frame
    facing = (normals.double() @ turned[:, :, 2].mT < SEARCH.facing_cosine).double()  # (M, K)
    of_side = facing.mT @ points / facing.sum(0).clamp_min(1.0)[:, None]
    found = [of_side - scale * (rotations @ scene.mean(0))]
    low, high = _object_extents(points, rotations, axes)
    seen = scene @ axes
    scene_low, scene_high = seen.amin(0), seen.amax(0)
    longer = (high - low - scale * (scene_high - scene_low)).clamp_min(0.0) / 2.0
    scene_end = torch.cat([(scene_low + scene_high)[:2] / 2.0, scene_low[2:]])
    object_end = torch.cat([(low + high)[:, :2] / 2.0, low[:, 2:]], 1)
    for aside in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        end = object_end + longer * longer.new_tensor([*aside, 0.0])
        found.append((turned @ (end - scale * scene_end)[..., None]).squeeze(-1))
    s = scene.new_full((len(found) * len(rotations),), scale)
    return Sim3(s, rotations.repeat(len(found), 1, 1), torch.cat(found))


def seed_poses_around(T_start: Sim3, generator: torch.Generator) -> Sim3:
    """A single pose and perturbed copies of it (H,): by about 10 degrees, 5 % of the object's size, 10 % of the
    scale. Drawn on the CPU, on the pose's device."""
    turn, shift, growth = SEARCH.start_spread
    count = SEARCH.start_copies
    spread = torch.tensor([turn] * 3 + [shift] * 3 + [growth], dtype=torch.float64)
    steps = torch.randn(count + 1, 7, generator=generator, dtype=torch.float64) * spread
    steps[0] = 0.0
    return T_start.expand(count + 1).perturb(steps.to(T_start.scale.device))


def _from_moments(
    scene_points: Tensor, object_points: Tensor, rotations: Tensor, scales: Tensor, bound: ScaleBound
) -> Sim3:
    scene_center, object_center = scene_points.mean(0), object_points.mean(0)
    ratio = _radius(object_points - object_center) / _radius(scene_points - scene_center)
    tried = (ratio * scales.double()).clamp(bound.low, bound.high)
    # Factors that the bound holds back are the same scale: each is tried once.
    tried = tried if bound.is_open else tried.new_tensor(sorted(set(tried.tolist())))
    s = tried[:, None].expand(-1, rotations.shape[0]).reshape(-1)
    R = rotations.repeat(len(tried), 1, 1)
    return Sim3(s, R, object_center - s[:, None] * (R @ scene_center))


def _from_extents(
    rotations: Tensor, box_axes: Tensor, of_object: tuple[Tensor, Tensor], of_scene: tuple[Tensor, Tensor]
) -> Sim3:
    """The scale that fits the extents along the box's axes best (geometric mean), the middles laid on each other."""
    ratio = (of_object[1] - of_object[0]) / (of_scene[1] - of_scene[0]).clamp_min(1e-9)  # (K, 3)
    s = ratio.clamp_min(1e-9).log().mean(-1).exp()
    turned_axes = rotations @ box_axes  # box axes to object axes
    object_middle = (turned_axes @ ((of_object[0] + of_object[1]) / 2)[..., None]).squeeze(-1)
    scene_middle = (turned_axes @ ((of_scene[0] + of_scene[1]) / 2)[..., None]).squeeze(-1)
    return Sim3(s, rotations, object_middle - s[:, None] * scene_middle)


def _object_extents(object_points: Tensor, rotations: Tensor, box_axes: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates (K, 3) of the object along the box's axes, for every rotation."""
    parts = -(-len(rotations) * len(object_points) // _POINTS_AT_ONCE)
    rows = object_points.T.contiguous()  # long rows: the lowest and the highest along one are found at once
    turns = (rotations @ box_axes).mT  # (K, 3, 3)
    found = [part.bmm(rows.expand(len(part), -1, -1)).aminmax(dim=2) for part in turns.tensor_split(max(1, parts))]
    return torch.cat([ends.min for ends in found]), torch.cat([ends.max for ends in found])


def _radius(offsets: Tensor) -> Tensor:
    return offsets.square().sum(-1).mean().sqrt()


# Evenly spread rotations: super-Fibonacci spirals over SO(3) (Alexa 2022), or turns about one axis.

_PHI = math.sqrt(2.0)
_PSI = 1.533751168755204288118041
"""The real root of psi^4 = psi + 4, as published."""


def start_rotations(options: RegistrationOptions, divisor: float = 1.0) -> Tensor:
    """(K, 3, 3) rotations that a search starts from: the option ``rotations`` over ``divisor``, 24 at least.

    They cover all orientations, or are turns about the option ``up_axis``.
    """
    count = max(SEARCH.min_rotations, int(options.robust.rotations / divisor))
    if options.up_axis is None:
        return super_fibonacci(count)
    turns = max(SEARCH.min_rotations, count // SEARCH.rotations_per_turn)
    return turns_about(axis_vector(options.up_axis), turns)


def super_fibonacci(count: int) -> Tensor:
    """(count, 3, 3) float64 rotations, spread over SO(3) with little discrepancy; always the same for a count."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    r, big_r = (s / count).sqrt(), (1.0 - s / count).sqrt()
    alpha, beta = 2 * math.pi * s / _PHI, 2 * math.pi * s / _PSI
    q = torch.stack([r * alpha.sin(), r * alpha.cos(), big_r * beta.sin(), big_r * beta.cos()], dim=-1)
    return matrix_from_quaternion(q)


def turns_about(axis: Tensor, count: int) -> Tensor:
    """(count, 3, 3) float64 rotations about the unit vector ``axis`` (3,), in equal steps, the identity first."""
    angle = torch.arange(count, dtype=torch.float64, device=axis.device) * (2 * math.pi / count)
    q = torch.cat([(angle / 2).sin().unsqueeze(-1) * axis.double(), (angle / 2).cos().unsqueeze(-1)], dim=-1)
    return matrix_from_quaternion(q)

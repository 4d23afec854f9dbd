"""Seeds for the search: rotations from a fixed, even set; scale and translation for each from the two shapes.

There are three ways to scale and move a rotated object onto the surface in the box, because each fails in some cases:
the centroids and root mean square radii (wrong with clutter), the extents of the points (wrong with one stray point),
the detection box itself (wrong when it is loose).
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import SEARCH
from regnf_core.robust.search.scale_bound import ANY_SCALE, ScaleBound

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
    lowest, highest = _extremes(local[None])
    low, high = _object_extents(object_points, rotations, box_axes)
    by_points = _from_extents(rotations, box_axes, (low, high), (lowest, highest))
    by_box = _from_extents(rotations, box_axes, (low, high), (-box_size[None] / 2, box_size[None] / 2))
    return Sim3.cat([by_moments, bound.limited_poses(by_points), bound.limited_poses(by_box)])


def seed_poses_around(T_start: Sim3, generator: torch.Generator) -> Sim3:
    """A single pose and perturbed copies of it (H,): by about 10 degrees, 5 % of the object's size, 10 % of the
    scale. Drawn on the CPU, on the pose's device."""
    turn, shift, growth = SEARCH.warm_start_spread
    count = SEARCH.warm_start_copies
    spread = torch.tensor([turn] * 3 + [shift] * 3 + [growth], dtype=torch.float64)
    steps = torch.randn(count + 1, 7, generator=generator, dtype=torch.float64) * spread
    steps[0] = 0.0
    return T_start.expand(count + 1).perturb(steps.to(T_start.scale.device))


def _from_moments(
    scene_points: Tensor, object_points: Tensor, rotations: Tensor, scales: Tensor, bound: ScaleBound
) -> Sim3:
    scene_center, object_center = scene_points.mean(0), object_points.mean(0)
    ratio = _radius(object_points, object_center) / _radius(scene_points, scene_center)
    tried = bound.limited(ratio * scales.double())
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
    rows = object_points.T.contiguous()
    turns = (rotations @ box_axes).mT  # (K, 3, 3)
    found = [_row_extremes(part.bmm(rows.expand(len(part), -1, -1))) for part in turns.tensor_split(max(1, parts))]
    low, high = (torch.cat(ends) for ends in zip(*found, strict=True))
    return low, high


def _extremes(points: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates (K, 3) of point sets (K, N, 3)."""
    return points.amin(1), points.amax(1)


def _row_extremes(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest numbers (K, 3) of rows (K, 3, N)."""
    low, high = rows.aminmax(dim=2)
    return low, high


def _radius(points: Tensor, center: Tensor) -> Tensor:
    return (points - center).square().sum(-1).mean().sqrt()

"""Distances to a surface on a grid, each with its gradient, made from oriented samples alone.

A look-up takes nanoseconds where a field takes microseconds. Its error is about the samples' spacing, which is enough
to compare thousands of poses; the fields themselves decide afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.geometry.bundle import Bundle
from regnf_core.geometry.metrics import NearestNeighbors
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled
from regnf_core.native.steps import NativeModel
from regnf_core.robust.constants import FEATURES, SEARCH
from regnf_core.robust.working_frame import Samples, on_host
from regnf_core.surface.feature_matching import DescribedCloud, MatchingOptions, describe, match, without_warnings

_CELLS = SEARCH.grid_cells


@dataclass(frozen=True, eq=False)
class DistanceGrid(Bundle):
    """Distance and gradient near a surface, in its frame: each cell holds a plane. Beyond the grid, the distance to it
    is added.

    planes: (4 V,), at_zero + gradient . point, z fastest · low, high, edge of a cell: (3, 1).
    """

    planes: Tensor
    low: Tensor
    high: Tensor
    edge: Tensor

    @classmethod
    def of(cls, points: Tensor, normals: Tensor, spacing: float, margin: float, thin: bool = False) -> DistanceGrid:
        """Of oriented surface points (N, 3); it covers their box grown by ``margin`` on every side. thin: see
        :func:`nearest_sample_distance`."""
        low, high = points.amin(0) - margin, points.amax(0) + margin
        edge = (high - low) / _CELLS
        axes = [low[k] + (torch.arange(_CELLS, device=points.device) + 0.5) * edge[k] for k in range(3)]
        centers = torch.cartesian_prod(*axes)
        found = compiled.nearest_to_cells(points, low, edge, _CELLS)
        value, gradient = nearest_sample_distance(points, normals, spacing, centers, thin, found)
        at_zero = value - (gradient * centers).sum(-1)
        planes = torch.cat([at_zero[:, None], gradient], 1).view(-1)
        return cls(planes, *(corner[:, None] for corner in (low, high, edge)))

    def native_model(self) -> NativeModel | None:
        """The same for compiled code, where it works."""
        steps = compiled.steps_for(self.planes)
        if steps is None:
            return None
        described = compiled.planes(_CELLS, self.low, self.high, self.edge, self.planes)
        return NativeModel(steps.grid, described, checked=False)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (M,) and gradient (M, 3) at points (M, 3): the nearest cell's, carried on to the point."""
        model = None if compiled.steps_for(points) is None else self.native_model()
        if model is not None:
            return model.value_and_gradient(points)
        places = points.T.contiguous()
        inside = torch.minimum(torch.maximum(places, self.low), self.high)
        cell = ((inside - self.low) / self.edge).int().clamp_(0, _CELLS - 1)
        # Planes are four numbers each, one after the other: the index moves on by one from number to number.
        index = cell[0].mul_(_CELLS).add_(cell[1]).mul_(_CELLS).add_(cell[2]).mul_(4)
        value = self.planes.index_select(0, index)
        gradient = torch.empty_like(places)
        for k in range(3):
            torch.index_select(self.planes, 0, index.add_(1), out=gradient[k])
            value.addcmul_(gradient[k], inside[k])
        _go_on(value, gradient, places - inside)
        return value, gradient.T


def _go_on(value: Tensor, gradient: Tensor, beyond: Tensor) -> None:
    """Outside of the grid, in place: the distance to the grid in addition, and the gradient away from it.

    Few places lie outside. On the CPU these alone are worked on; elsewhere it would take a copy to know which.
    """
    outside = beyond.any(0)
    if on_host(value):
        out = outside.nonzero().squeeze(-1)
        distance, away = _away(beyond[:, out])
        value[out] += distance
        gradient[:, out] = away
    else:
        distance, away = _away(beyond)
        value.add_(distance)
        gradient.copy_(torch.where(outside, away, gradient))


def _away(beyond: Tensor) -> tuple[Tensor, Tensor]:
    """Length (M,) and direction (3, M) of vectors (3, M)."""
    distance = beyond.norm(dim=0)
    return distance, beyond / distance.clamp_min(1e-9)


def distance_grid(samples: Samples, spacing: float, thin: bool = False) -> DistanceGrid:
    """The grid around a surface's samples, ``spacing`` apart, in their working frame. thin: see
    :func:`nearest_sample_distance`."""
    return DistanceGrid.of(samples.on_surface(), samples.normals, spacing, SEARCH.grid_margin, thin)


def nearest_sample_distance(
    points: Tensor,
    normals: Tensor,
    spacing: float,
    queries: Tensor,
    thin: bool = False,
    found: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Signed distance (M,) and gradient (M, 3) at queries (M, 3), to the surface of oriented points (N, 3).

    Far away: the distance to the nearest point, signed by its normal. Close: the distance to its tangent plane.
    thin: of a wall thinner than the spacing the face that the query is in front of counts; the nearest point may be the
    other's · found: distance (M,) and number (M,) of the nearest point, where they are known.
    """
    far, nearest = NearestNeighbors(points).query(queries) if found is None else found
    if thin:
        far, nearest = _of_the_face_in_front(points, normals, queries, far, nearest)
    offset = queries - points[nearest]
    n = normals[nearest]
    height = (offset * n).sum(-1)
    sign = torch.where(height >= 0, 1.0, -1.0)
    # Between samples the nearest one is farther than the surface, and its tangent plane is not.
    close = far < SEARCH.tangent_spacings * spacing
    value = torch.where(close, height, sign * far)
    gradient = torch.where(close[:, None], n, sign[:, None] * offset / far.clamp_min(1e-9)[:, None])
    return value, gradient


def _of_the_face_in_front(
    points: Tensor, normals: Tensor, queries: Tensor, far: Tensor, nearest: Tensor
) -> tuple[Tensor, Tensor]:
    """Distance (M,) and number (M,) of the point that is nearest to each query (M, 3), but for queries behind it: these
    have the nearest of the next few that faces the other way, has the query in front of it, and lies between both."""
    height = ((queries - points[nearest]) * normals[nearest]).sum(-1)
    behind = (height < 0.0).nonzero().squeeze(-1)
    apart, others = NearestNeighbors(points).query_several(queries[behind], SEARCH.sheet_neighbors)
    heights = ((queries[behind, None] - points[others]) * normals[others]).sum(-1)
    opposite = (normals[others] * normals[nearest[behind], None]).sum(-1) < SEARCH.sheet_cosine
    in_front = opposite & (heights >= 0.0) & (heights <= -height[behind, None])
    first = in_front.int().argmax(1, keepdim=True)
    found = in_front.any(1)
    chosen = behind[found]
    far, nearest = far.clone(), nearest.clone()
    far[chosen], nearest[chosen] = apart.gather(1, first)[found, 0], others.gather(1, first)[found, 0]
    return far, nearest


# Seeds from feature matches: FPFH descriptors on clouds of one size, RANSAC over similarity transforms.
#
# The published method starts from the same features (Rusu et al. 2009). Here they do not depend on units: both clouds
# are scaled to a root mean square radius of one before they are described, and the scale is estimated with the rest.

_MATCHING = MatchingOptions(
    max_distance=FEATURES.inlier_distance * FEATURES.voxel,
    with_scaling=True,
    edge_length_ratio=None,
    max_draws=FEATURES.iterations,
)


def feature_seeds(scene: Samples, obj: Samples, count: int, seed: int) -> Sim3:
    """At most ``count`` poses (H,) between the working frames, float64, CPU; none where the features give none.

    Deterministic for a seed, whatever the number of threads and the samples' device. Loads open3d.
    """
    scene, obj = scene.on("cpu"), obj.on("cpu")
    to_scene, to_object = _normalizing(scene), _normalizing(obj)
    with without_warnings():
        source, target = _described(scene, to_scene), _described(obj, to_object)
        if min(len(source), len(target)) < FEATURES.min_points:
            return Sim3.cat([])
        drawn = [_similarity(match(source, target, _MATCHING, seed * 1009 + draw)) for draw in range(count)]
    return Sim3.cat([to_object.inverse() @ T @ to_scene for T in drawn if T is not None])


def _normalizing(samples: Samples) -> Sim3:
    """The similarity that moves the samples' centroid to 0 and makes their root mean square radius one."""
    points = samples.on_surface().double()
    center = points.mean(0)
    scale = 1.0 / (points - center).square().sum(-1).mean().sqrt().clamp_min(1e-9)
    return Sim3(scale, torch.eye(3, dtype=torch.float64), -scale * center)


def _described(samples: Samples, normalize: Sim3) -> DescribedCloud:
    """The normalized cloud with its descriptors."""
    points = normalize.apply(samples.on_surface().double())
    return describe(points, samples.normals, FEATURES.voxel, FEATURES.feature_radius)


def _similarity(matrix: Tensor | None) -> Sim3 | None:
    """The match as a similarity, if it is one: no reflection, no collapse."""
    if matrix is None or not torch.isfinite(matrix).all():
        return None
    scale = torch.linalg.det(matrix[:3, :3]).clamp_min(0.0) ** (1.0 / 3.0)
    if not FEATURES.scales[0] < float(scale) < FEATURES.scales[1]:
        return None
    U, _, Vh = torch.linalg.svd(matrix[:3, :3])
    rotation = U @ Vh
    return Sim3(scale, rotation, matrix[:3, 3]) if float(torch.linalg.det(rotation)) > 0 else None

"""Errors of an estimated T_object_scene against the true one.

Three are the paper's (and nerf2nerf's). The others are the error of the object's center, a rotation error that does not
depend on the choice of angles, and distances between true and estimated surface points.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from regnf_core.geometry.exponential_map import skew
from regnf_core.geometry.sim3 import Sim3
from regnf_core.native import steps as compiled

# Euler angles as the paper learns and reports them: roll, pitch, yaw about the fixed axes x, y, z, in that order.
#
# They are singular at pitch +-pi/2 (gimbal lock); the preset ``paper`` uses them because the published method does.


def rotation_from_euler(angles: Tensor) -> Tensor:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (..., 3, 3), of angles (..., 3) = (roll, pitch, yaw), radians. Differentiable."""
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = [
        cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
        sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
        -sp, cp * sr, cp * cr,
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*angles.shape[:-1], 3, 3)


def euler_from_rotation(R: Tensor) -> Tensor:
    """(roll, pitch, yaw) (..., 3) in radians, pitch within +-pi/2. Where they are singular, roll is zero."""
    cosine = torch.hypot(R[..., 2, 1], R[..., 2, 2])
    pitch = torch.atan2(-R[..., 2, 0], cosine)
    singular = cosine < 1e-9
    roll = torch.where(singular, torch.zeros_like(pitch), torch.atan2(R[..., 2, 1], R[..., 2, 2]))
    yaw = torch.where(singular, torch.atan2(-R[..., 0, 1], R[..., 1, 1]), torch.atan2(R[..., 1, 0], R[..., 0, 0]))
    return torch.stack([roll, pitch, yaw], dim=-1)


# Neighbors, spacing and size of point sets: exact on any device.

_DISTANCES_AT_ONCE = 2**25
"""Of all points to some of those requested, where there is no tree: bounds memory, at some 500 MB."""


class NearestNeighbors:
    """A search structure over points (M, 3): a k-d tree on the CPU, all distances elsewhere. Results are not
    differentiable."""

    def __init__(self, points: Tensor) -> None:
        self.points = points.detach()

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points.numpy())

    def query(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (N,) to the nearest point and its index (N,), for points (N, 3)."""
        distance, index = self.query_several(points, 1)
        return distance[:, 0], index[:, 0]

    def query_several(self, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Distances (N, K) to the nearest points, nearest first, and their indices (N, K); K = ``count``, at most M."""
        count = min(count, len(self.points))
        if self.points.device.type != "cpu":
            return nearest_of_all(self.points, points.detach(), count)
        # Compiled code makes its tree for each call: half of the time where the tree is not what takes it.
        if len(points) >= len(self.points):
            found = compiled.nearest(self.points, points.detach(), count)
            if found is not None:
                return found
        distance, index = self._tree.query(points.detach().cpu().numpy(), k=range(1, count + 1))
        return torch.as_tensor(distance).to(points), torch.as_tensor(index, device=points.device)


def nearest_of_all(points: Tensor, queries: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances (N, K) from queries (N, 3) to the ``count`` nearest of points (M, 3), nearest first, and the indices
    (N, K): by all distances, in float64, in parts that bound memory. No part of it is read on the CPU."""
    few = max(1, _DISTANCES_AT_ONCE // len(points))
    found = []
    for part in torch.split(queries.double(), few):
        apart = (part[:, None] - points.double()).square_().sum(-1)
        found.append(apart.topk(count, dim=1, largest=False))
    squares, index = (torch.cat(parts) for parts in zip(*found, strict=True))
    return squares.sqrt().to(queries), index


def gaps(points: Tensor) -> Tensor:
    """(N,) distance from each point of a cloud (N, 3), N >= 1, to its third neighbor: how sparse the cloud is there."""
    distance, _ = NearestNeighbors(points).query_several(points.detach(), 4)  # the nearest is the point itself
    return distance[:, -1]


def diameter(points: Tensor) -> float:
    """The largest distance between any two of the points (N, 3), N >= 1; found among the convex hull's corners."""
    from scipy.spatial import ConvexHull, QhullError
    from scipy.spatial.distance import pdist

    array = points.detach().double().cpu().numpy()
    if array.shape[0] < 2:
        return 0.0
    try:
        array = array[ConvexHull(array).vertices]
    except QhullError:  # flat or tiny clouds have no hull; their own extreme points are few enough below
        directions = np.random.default_rng(0).normal(size=(512, 3))
        heights = array @ directions.T
        array = array[np.unique(np.concatenate([heights.argmin(0), heights.argmax(0)]))]
    return float(pdist(array).max(initial=0.0))


def rotation_error(estimate: Sim3, truth: Sim3) -> float:
    """Angle, radians, of the rotation between estimate and truth."""
    turned = estimate.rotation @ truth.rotation.mT
    difference = Sim3(torch.ones_like(truth.scale), turned, torch.zeros_like(truth.translation))
    return float(difference.log()[:3].norm())


def _apart(estimate: Sim3, truth: Sim3, points: Tensor) -> Tensor:
    """(...,) distances between the estimated and the true place of object points (..., 3), object units."""
    away: Tensor = (estimate.apply_inverse(points) - truth.apply_inverse(points)).norm(dim=-1)
    return float(truth.scale) * away


def add_s(estimate: Sim3, truth: Sim3, points: Tensor) -> float:
    """ADD-S: mean distance from true to the nearest estimated surface point, object points (N, 3), object units."""
    placed = estimate.apply_inverse(points.double())
    distance, _ = NearestNeighbors(placed).query(truth.apply_inverse(points.double()))
    return float(truth.scale) * float(distance.mean())


def paper_errors(estimate: Sim3, truth: Sim3) -> dict[str, float]:
    """The paper's errors by name, root mean squares: of x, y, z, object units; of roll, pitch, yaw, each wrapped to
    +-pi. The translation's grows with the distance of the scene's origin from the object: it holds the rotation's lever
    arm."""
    turned = euler_from_rotation(estimate.rotation) - euler_from_rotation(truth.rotation)
    wrapped = torch.remainder(turned + math.pi, 2 * math.pi) - math.pi
    return {
        "translation_rmse": float((estimate.translation - truth.translation).square().mean().sqrt()),
        "euler_rmse_rad": float(wrapped.square().mean().sqrt()),
        "scale_error": float((estimate.scale - truth.scale).abs()),
    }


def errors_against_truth(estimate: Sim3, truth: Sim3, points: Tensor, center: Tensor | None = None) -> dict[str, float]:
    """The errors by name that do not depend on where the scene's origin is.

    points: (N, 3), surface points of the object, object frame · center: (3,), of the object; None: the points' mean.
    ``center_error`` is in scene units, ``mssd`` and ``add_s`` are in object units. ``_share`` means: of the object's
    diameter, or, for the scale, of the true scale.
    """
    points = points.double().cpu()
    size = max(diameter(points), 1e-12)
    off = float(_apart(estimate, truth, points.mean(0) if center is None else center.double().cpu()))
    largest, nearest = float(_apart(estimate, truth, points).max()), add_s(estimate, truth, points)
    return {
        "center_error": off / float(truth.scale),
        "center_error_share": off / size,
        "rotation_error_rad": rotation_error(estimate, truth),
        "scale_error_share": float((estimate.scale - truth.scale).abs()) / float(truth.scale),
        "mssd": largest,
        "mssd_share": largest / size,
        "add_s": nearest,
        "add_s_share": nearest / size,
    }


# How far apart poses place an object, and the best poses of a batch that are distinct by this measure.


def displacement(T: Sim3, reference: Sim3, points: Tensor) -> Tensor:
    """Largest distance, target units, between the images of the object points (N, 3) under T^-1 and one reference^-1.

    (H,): how far apart two poses place the object, measured in the frame it is placed in and scaled to its own units.
    """
    placed, other = T.apply_inverse(points.double()), reference.apply_inverse(points.double())
    apart: Tensor = reference.scale * (placed - other).norm(dim=-1).amax(-1)
    return apart


def distinct(T: Sim3, scores: Tensor, points: Tensor, apart: float, limit: int) -> Tensor:
    """Numbers of the best poses (lowest score first), no two of which place ``points`` closer together than ``apart``.

    points: (N, 3) of the object; a handful of its extreme points is enough. One pose decides on the next: that is done
    on the CPU, whatever device T (H,) and scores (H,) are on; the numbers (K,) are on the CPU too.
    """
    T, scores, points = T.on("cpu"), scores.cpu(), points.cpu()
    order = scores.argsort()
    # Plain arrays: a call costs less there, and all of them are small.
    placed = T[order].apply_inverse(points.double()).mT.contiguous().numpy()  # (H, 3, N)
    reach = (apart / T.scale[order].double()).square().numpy()
    numbers, left = order.numpy(), np.arange(len(order))
    chosen: list[int] = []
    while len(left) and len(chosen) < limit:
        chosen.append(int(numbers[left[0]]))
        squares = np.square(placed[1:] - placed[0]).sum(1).max(-1)
        far = ~(squares < reach[left[0]])
        left, placed = left[1:][far], placed[1:][far]
    return torch.tensor(chosen, dtype=torch.long)


# The uncertainty of a pose in degrees, scene units and percent, from its covariance.


def center_covariance(covariance: Tensor, T_object_scene: Sim3, center: Tensor) -> Tensor:
    """(3, 3) float64, scene frame and units: of the place of an object's point ``center`` (3,), object frame.

    The point lies at p = R^T (c - t) / s. To first order a perturbation moves it by R^T ((c - t) x omega - dt -
    (c - t) log_s) / s. The lever arm c - t cancels what the translation's entries owe to a far origin, so all of it is
    done in float64.
    """
    arm = center.double() - T_object_scene.translation.double()
    J = torch.cat([skew(arm), -torch.eye(3, dtype=torch.float64), -arm[:, None]], 1)
    J = T_object_scene.rotation.double().mT @ J / T_object_scene.scale.double()
    found: Tensor = J @ covariance.double() @ J.mT
    return found


def uncertainty(covariance: Tensor, T_object_scene: Sim3, center: Tensor) -> dict[str, Any]:
    """Standard deviations from the covariance (7, 7); null for an entry that is not a variance.

    center_scene: of the place of the object's center (3,), object frame, along the scene's x, y, z, scene units ·
    rotation_deg: degrees about the object frame's x, y, z · scale_percent: of the scale.
    """
    variances = covariance.diagonal().tolist()
    degrees = [_root(variance) for variance in variances[:3]]
    growth = _root(variances[6])
    return {
        "center_scene": [_root(v) for v in center_covariance(covariance, T_object_scene, center).diagonal().tolist()],
        "rotation_deg": [None if sigma is None else math.degrees(sigma) for sigma in degrees],
        "scale_percent": None if growth is None else 100.0 * growth,
    }


def _root(variance: float) -> float | None:
    return math.sqrt(variance) if 0.0 <= variance < math.inf else None

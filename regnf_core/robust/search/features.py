"""Seeds from feature matches: FPFH descriptors on clouds of one size, RANSAC over similarity transforms.

The published method starts from the same features (Rusu et al. 2009). Here they do not depend on units: both clouds are
scaled to a root mean square radius of one before they are described, and the scale is estimated with the rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.constants import FEATURES
from regnf_core.robust.samples import Samples
from regnf_core.surface.feature_matching import DescribedCloud, MatchingOptions, describe, match, without_warnings

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
    scene, obj = scene.to("cpu"), obj.to("cpu")
    found: list[Sim3] = []
    to_scene, to_object = _normalizing(scene), _normalizing(obj)
    with without_warnings():
        source, target = _described(scene, to_scene), _described(obj, to_object)
        if min(len(source), len(target)) < FEATURES.min_points:
            return Sim3.cat([])
        for draw in range(count):
            T = _similarity(match(source, target, _MATCHING, seed * 1009 + draw))
            if T is not None:
                found.append(to_object.inverse() @ T @ to_scene)
    return Sim3.cat(found)


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

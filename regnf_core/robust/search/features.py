"""Seeds from feature matches: FPFH descriptors on clouds of one size, RANSAC over similarity transforms.

What the published method starts from (Rusu et al. 2009), made free of units: both clouds are scaled to a root mean
square radius of one before they are described, and the scale is estimated with the rest.
"""

from __future__ import annotations

from typing import Any

import torch

from regnf_core.geometry.sim3 import Sim3
from regnf_core.robust.residuals import Samples

_VOXEL = 0.08  # root mean square radii
_FEATURE_RADIUS, _NEIGHBORS = 4.0, 100  # voxels, points
_INLIER = 1.5  # voxels
_ITERATIONS, _CONFIDENCE = 20_000, 0.999
_FEWEST = 30  # points a described cloud must have
_SCALES = (0.2, 5.0)  # of the normalized clouds: what lies beyond is no match


def feature_seeds(scene: Samples, obj: Samples, count: int, seed: int) -> Sim3:
    """At most ``count`` poses (H,) between the working frames, float64; none where the features give none.

    Deterministic for a seed, whatever the number of threads. Loads open3d.
    """
    import open3d
    from open3d.pipelines import registration

    found: list[Sim3] = []
    to_scene, to_object = _normalizing(scene), _normalizing(obj)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        source, target = _described(scene, to_scene), _described(obj, to_object)
        for draw in range(count):
            if source is None or target is None:
                break
            open3d.utility.random.seed((seed * 1009 + draw) % 2**31)
            matched = registration.registration_ransac_based_on_feature_matching(
                source[0],
                target[0],
                source[1],
                target[1],
                mutual_filter=True,
                max_correspondence_distance=_INLIER * _VOXEL,
                estimation_method=registration.TransformationEstimationPointToPoint(with_scaling=True),
                ransac_n=4,
                checkers=[registration.CorrespondenceCheckerBasedOnDistance(_INLIER * _VOXEL)],
                criteria=registration.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE),
            )
            T = _similarity(matched)
            if T is not None:
                found.append(to_object.inverse() @ T @ to_scene)
    return Sim3.cat(found)


def _normalizing(samples: Samples) -> Sim3:
    """The similarity that moves the samples' centroid to 0 and makes their root mean square radius one."""
    points = samples.on_surface().double()
    center = points.mean(0)
    scale = 1.0 / (points - center).square().sum(-1).mean().sqrt().clamp_min(1e-9)
    return Sim3(scale, torch.eye(3, dtype=torch.float64), -scale * center)


def _described(samples: Samples, normalize: Sim3) -> tuple[Any, Any] | None:
    """The normalized cloud, one point a voxel, and its descriptors; None when it is too small to be described."""
    import open3d
    from open3d.pipelines import registration

    points = normalize.apply(samples.on_surface().double())
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.numpy()))
    cloud.normals = open3d.utility.Vector3dVector(samples.normals.double().numpy())
    cloud = cloud.voxel_down_sample(_VOXEL)
    if len(cloud.points) < _FEWEST:
        return None
    reach = open3d.geometry.KDTreeSearchParamHybrid(_FEATURE_RADIUS * _VOXEL, _NEIGHBORS)
    return cloud, registration.compute_fpfh_feature(cloud, reach)


def _similarity(matched: Any) -> Sim3 | None:
    """The match as a similarity, if it is one: no reflection, no collapse."""
    matrix = torch.tensor(matched.transformation.tolist(), dtype=torch.float64)
    if len(matched.correspondence_set) == 0 or not torch.isfinite(matrix).all():
        return None
    scale = torch.linalg.det(matrix[:3, :3]).clamp_min(0.0) ** (1.0 / 3.0)
    if not _SCALES[0] < float(scale) < _SCALES[1]:
        return None
    U, _, Vh = torch.linalg.svd(matrix[:3, :3])
    rotation = U @ Vh
    return Sim3(scale, rotation, matrix[:3, 3]) if float(torch.linalg.det(rotation)) > 0 else None

"""The initial transform from two point clouds: FPFH features, RANSAC, ICP (paper, section III-C.2).

Both clouds are centered first. The transform found is rigid; its scale is 1, as published.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from regnf_core.errors import InitializationError
from regnf_core.geometry.sim3 import Sim3
from regnf_core.options import InitializationOptions
from regnf_core.result import SurfaceSamples

if TYPE_CHECKING:
    import open3d

_FEATURE_RADIUS_VOXELS = 5.0
_FEATURE_NEIGHBORS = 100
_RANSAC_POINTS = 4
_RANSAC_CONFIDENCE = 0.999
_MIN_VOXELS = 10  # a cloud with fewer has no shape to speak of
_SEED_STRIDE = 7919  # between the draws of one seed, so that neighboring seeds share none


def initial_transform(
    scene_samples: SurfaceSamples,
    object_samples: SurfaceSamples,
    options: InitializationOptions,
    seed: int,
    disagreement: Callable[[Sim3], float] = lambda T_object_scene: 0.0,
) -> Sim3:
    """T_object_scene with scale 1 from the surface points of both fields, float64 on the CPU.

    Of ``options.draws`` RANSAC draws the one with the least ``disagreement`` is kept; one draw is the published method.
    Deterministic for a seed, whatever the number of threads.
    Raises InitializationError (NO_INITIAL_TRANSFORM) when the features give no transform.
    """
    scene_center, object_center = _center(scene_samples), _center(object_samples)
    scene_cloud = _described(scene_samples, scene_center, options.voxel_size)
    object_cloud = _described(object_samples, object_center, options.voxel_size)
    found: list[Sim3] = []
    with _quiet_open3d():
        for draw in range(options.draws):
            T_centered = _ransac_and_icp(scene_cloud, object_cloud, options, seed + _SEED_STRIDE * draw)
            if T_centered is not None:
                found.append(Sim3.from_translation(object_center) @ T_centered @ Sim3.from_translation(-scene_center))
    if not found:
        raise InitializationError("feature matching found no transform between the two surfaces")
    return found[0] if len(found) == 1 else min(found, key=disagreement)


def _quiet_open3d() -> AbstractContextManager[Any]:
    """Open3D writes its warnings to standard output, which belongs to the caller."""
    import open3d

    context: AbstractContextManager[Any] = open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error)
    return context


def _center(samples: SurfaceSamples) -> Tensor:
    return samples.points.double().cpu().mean(0)


def _described(samples: SurfaceSamples, center: Tensor, voxel_size: float) -> tuple[open3d.geometry.PointCloud, Any]:
    """The centered cloud thinned to one point a voxel, and its FPFH descriptors."""
    import open3d
    from open3d.pipelines import registration

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector((samples.points.double().cpu() - center).numpy()))
    cloud.normals = open3d.utility.Vector3dVector(samples.normals.double().cpu().numpy())
    cloud = cloud.voxel_down_sample(voxel_size)
    if len(cloud.points) < _MIN_VOXELS:
        raise InitializationError(f"the surface fills only {len(cloud.points)} voxels of {voxel_size}: too few")
    search = open3d.geometry.KDTreeSearchParamHybrid(_FEATURE_RADIUS_VOXELS * voxel_size, _FEATURE_NEIGHBORS)
    return cloud, registration.compute_fpfh_feature(cloud, search)


def _ransac_and_icp(
    scene: tuple[Any, Any], obj: tuple[Any, Any], options: InitializationOptions, seed: int
) -> Sim3 | None:
    """One draw: RANSAC over mutual feature matches, then point-to-point ICP. None when no match survives the checks."""
    import open3d
    from open3d.pipelines import registration

    open3d.utility.random.seed(seed % 2**31)
    distance = options.ransac_distance_voxels * options.voxel_size
    rigid = registration.TransformationEstimationPointToPoint(with_scaling=False)
    matched = registration.registration_ransac_based_on_feature_matching(
        scene[0],
        obj[0],
        scene[1],
        obj[1],
        mutual_filter=True,
        max_correspondence_distance=distance,
        estimation_method=rigid,
        ransac_n=_RANSAC_POINTS,
        checkers=[
            registration.CorrespondenceCheckerBasedOnEdgeLength(options.edge_length_ratio),
            registration.CorrespondenceCheckerBasedOnDistance(distance),
        ],
        criteria=registration.RANSACConvergenceCriteria(options.ransac_iterations, _RANSAC_CONFIDENCE),
    )
    if len(matched.correspondence_set) == 0:
        return None
    reach = options.icp_distance_voxels * options.voxel_size
    refined = registration.registration_icp(scene[0], obj[0], reach, matched.transformation, rigid)
    return Sim3.from_matrix(torch.tensor(refined.transformation.tolist(), dtype=torch.float64))

"""The initial transform from two point clouds: FPFH features, RANSAC, ICP (paper, section III-C.2).

Both clouds are centered first. The transform found is rigid; its scale is 1, as published.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from regnf_core.errors import InitializationError
from regnf_core.geometry.sim3 import Sim3
from regnf_core.geometry.surface_samples import SurfaceSamples
from regnf_core.options import InitializationOptions
from regnf_core.surface.feature_matching import DescribedCloud, MatchingOptions, describe, match, without_warnings

_FEATURE_RADIUS_VOXELS = 5.0
_MIN_VOXELS = 10  # a cloud with fewer points has too little shape for features
_SEED_STRIDE = 7919  # between the draws of one seed, so that neighboring seeds share none


def initial_transform(
    scene_samples: SurfaceSamples,
    object_samples: SurfaceSamples,
    options: InitializationOptions,
    seed: int,
    score: Callable[[Sim3], float] = lambda T_object_scene: 0.0,
) -> Sim3:
    """T_object_scene with scale 1 from the surface points of both fields, float64 on the CPU.

    Of ``options.draws`` RANSAC draws the one with the lowest ``score`` is kept; one draw is the published method.
    Deterministic for a seed, whatever the number of threads.
    Raises InitializationError (NO_INITIAL_TRANSFORM) when the features give no transform.
    """
    scene_center, object_center = _center(scene_samples), _center(object_samples)
    scene_cloud = _described(scene_samples, scene_center, options.voxel_size)
    object_cloud = _described(object_samples, object_center, options.voxel_size)
    found: list[Sim3] = []
    with without_warnings():
        for draw in range(options.draws):
            T_centered = _ransac_and_icp(scene_cloud, object_cloud, options, seed + _SEED_STRIDE * draw)
            if T_centered is not None:
                found.append(Sim3.from_translation(object_center) @ T_centered @ Sim3.from_translation(-scene_center))
    if not found:
        raise InitializationError("feature matching found no transform between the two surfaces")
    return found[0] if len(found) == 1 else min(found, key=score)


def _center(samples: SurfaceSamples) -> Tensor:
    return samples.points.double().cpu().mean(0)


def _described(samples: SurfaceSamples, center: Tensor, voxel_size: float) -> DescribedCloud:
    """The centered cloud with its descriptors. Raises InitializationError (NO_INITIAL_TRANSFORM) for a tiny one."""
    described = describe(samples.points.double().cpu() - center, samples.normals, voxel_size, _FEATURE_RADIUS_VOXELS)
    if len(described) < _MIN_VOXELS:
        raise InitializationError(f"the surface fills only {len(described)} voxels of {voxel_size}: too few")
    return described


def _ransac_and_icp(
    scene: DescribedCloud, obj: DescribedCloud, options: InitializationOptions, seed: int
) -> Sim3 | None:
    """One draw: RANSAC over mutual feature matches, then point-to-point ICP. None when no match survives the checks."""
    from open3d.pipelines import registration

    matching = MatchingOptions(
        max_distance=options.ransac_distance_voxels * options.voxel_size,
        with_scaling=False,
        edge_length_ratio=options.edge_length_ratio,
        max_draws=options.ransac_iterations,
    )
    matched = match(scene, obj, matching, seed)
    if matched is None:
        return None
    reach = options.icp_distance_voxels * options.voxel_size
    rigid = registration.TransformationEstimationPointToPoint(with_scaling=False)
    refined = registration.registration_icp(scene.cloud, obj.cloud, reach, matched.numpy(), rigid)
    return Sim3.from_matrix(torch.tensor(refined.transformation.tolist(), dtype=torch.float64))

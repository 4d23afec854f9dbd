"""Transforms from feature matches: FPFH descriptors (Rusu et al. 2009) and RANSAC, by Open3D, loaded on first use."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    import open3d

_NEIGHBORS = 100  # points that a descriptor looks at, at most
_MATCHES_PER_DRAW = 4
_CONFIDENCE = 0.999


@dataclass(frozen=True, eq=False)
class DescribedCloud:
    """A point cloud with one point a voxel, and one FPFH descriptor a point."""

    cloud: open3d.geometry.PointCloud
    descriptors: Any

    def __len__(self) -> int:
        return len(self.cloud.points)


@dataclass(frozen=True)
class MatchingOptions:
    """What counts as a match.

    max_distance: of two matched points, the clouds' unit · with_scaling: a similarity transform, else a rigid one ·
    edge_length_ratio: draws whose edges differ by more are dropped; None: no draw is dropped · max_draws: of RANSAC.
    """

    max_distance: float
    with_scaling: bool
    edge_length_ratio: float | None
    max_draws: int


def describe(points: Tensor, normals: Tensor, voxel_size: float, radius_voxels: float) -> DescribedCloud:
    """One point a voxel of points (N, 3) with unit normals (N, 3), and descriptors of ``radius_voxels`` about each."""
    import open3d
    from open3d.pipelines import registration

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.double().cpu().numpy()))
    cloud.normals = open3d.utility.Vector3dVector(normals.double().cpu().numpy())
    cloud = cloud.voxel_down_sample(voxel_size)
    neighborhood = open3d.geometry.KDTreeSearchParamHybrid(radius_voxels * voxel_size, _NEIGHBORS)
    return DescribedCloud(cloud, registration.compute_fpfh_feature(cloud, neighborhood))


def match(source: DescribedCloud, target: DescribedCloud, options: MatchingOptions, seed: int) -> Tensor | None:
    """(4, 4) float64 transform from source to target by RANSAC over mutual matches; None when no match is left.

    Deterministic for a seed, whatever the number of threads.
    """
    import open3d
    from open3d.pipelines import registration

    open3d.utility.random.seed(seed % 2**31)
    checkers = [registration.CorrespondenceCheckerBasedOnDistance(options.max_distance)]
    if options.edge_length_ratio is not None:
        checkers.insert(0, registration.CorrespondenceCheckerBasedOnEdgeLength(options.edge_length_ratio))
    found = registration.registration_ransac_based_on_feature_matching(
        source.cloud,
        target.cloud,
        source.descriptors,
        target.descriptors,
        mutual_filter=True,
        max_correspondence_distance=options.max_distance,
        estimation_method=registration.TransformationEstimationPointToPoint(with_scaling=options.with_scaling),
        ransac_n=_MATCHES_PER_DRAW,
        checkers=checkers,
        criteria=registration.RANSACConvergenceCriteria(options.max_draws, _CONFIDENCE),
    )
    if len(found.correspondence_set) == 0:
        return None
    return torch.tensor(found.transformation.tolist(), dtype=torch.float64)


def without_warnings() -> AbstractContextManager[Any]:
    """Keeps Open3D's warnings from standard output, which belongs to the caller."""
    import open3d

    context: AbstractContextManager[Any] = open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error)
    return context

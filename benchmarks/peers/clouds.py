"""Point clouds for the methods that know only points: normalized in size or as they are, and in open3d's form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core import Sim3
from regnf_core.errors import InitializationError
from regnf_core.geometry.surface_samples import SurfaceSamples

VOXEL = 0.08
"""Edge of the voxels, in root mean square radii of the object's cloud: a fortieth of its diameter, about."""
_FEATURE_RADIUS, _NEIGHBORS = 5.0, 100  # voxels, points: what open3d's own tutorial uses
_FEWEST = 10


@dataclass(frozen=True, eq=False)
class CloudPair:
    """The scene's and the object's points in the frames that a method works in, and the way back.

    scene, object: (N, 3) and (M, 3) float64 with unit normals · voxel: edge of the voxels, working units.
    """

    scene: NDArray[np.float64]
    scene_normals: NDArray[np.float64]
    object: NDArray[np.float64]
    object_normals: NDArray[np.float64]
    voxel: float
    T_work_scene: Sim3
    T_work_object: Sim3

    def to_object_scene(self, T_object_scene_work: NDArray[np.float64]) -> Sim3:
        """T_object_scene from the 4x4 matrix that carries the scene's working points onto the object's.

        Raises InitializationError when the matrix is no similarity.
        """
        return self.T_work_object.inverse() @ similarity(T_object_scene_work) @ self.T_work_scene


def cloud_pair(scene: SurfaceSamples, obj: SurfaceSamples, normalized: bool, voxel: float = VOXEL) -> CloudPair:
    """Both clouds moved to their centroids; ``normalized``: each also scaled to a root mean square radius of one.

    voxel: in root mean square radii of the object.
    """
    T_scene, _ = _centering(scene, normalized)
    T_object, object_radius = _centering(obj, normalized)
    return CloudPair(
        T_scene.apply(scene.points.double()).numpy(),
        scene.normals.double().numpy(),
        T_object.apply(obj.points.double()).numpy(),
        obj.normals.double().numpy(),
        voxel * (1.0 if normalized else object_radius),
        T_scene,
        T_object,
    )


def described(points: NDArray[np.float64], normals: NDArray[np.float64], voxel: float) -> tuple[Any, Any]:
    """An open3d cloud with one point a voxel, and its FPFH descriptors. Loads open3d.

    Raises InitializationError when too few voxels are filled.
    """
    import open3d
    from open3d.pipelines import registration

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    cloud = cloud.voxel_down_sample(voxel)
    if len(cloud.points) < _FEWEST:
        raise InitializationError(f"the surface fills only {len(cloud.points)} voxels: too few")
    reach = open3d.geometry.KDTreeSearchParamHybrid(_FEATURE_RADIUS * voxel, _NEIGHBORS)
    return cloud, registration.compute_fpfh_feature(cloud, reach)


def similarity(matrix: NDArray[np.float64]) -> Sim3:
    """A 4x4 matrix from another package as a similarity.

    Its linear part may be off by a rounding error: the nearest rotation is taken, and the cube root of its determinant
    as the scale. Raises InitializationError when it is not finite, mirrors space, or shrinks it to nothing.
    """
    M = torch.tensor(np.asarray(matrix).tolist(), dtype=torch.float64)
    if not bool(torch.isfinite(M).all()):
        raise InitializationError("the method gave a transform that is not finite")
    determinant = torch.linalg.det(M[:3, :3])
    if float(determinant) <= 1e-12:
        raise InitializationError("the method gave a transform that mirrors or flattens space")
    U, _, Vh = torch.linalg.svd(M[:3, :3])
    return Sim3(determinant ** (1.0 / 3.0), U @ Vh, M[:3, 3].clone())


def _centering(samples: SurfaceSamples, normalized: bool) -> tuple[Sim3, float]:
    points = samples.points.double()
    center = points.mean(0)
    radius = (points - center).square().sum(-1).mean().sqrt().clamp_min(1e-9)
    scale = 1.0 / radius if normalized else torch.ones((), dtype=torch.float64)
    return Sim3(scale, torch.eye(3, dtype=torch.float64), -scale * center), float(radius)

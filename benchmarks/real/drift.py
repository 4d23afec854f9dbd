"""What the maps of the two halves have in common at a thing: how far it has drifted, how much of it both show."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import open3d
from scipy.spatial import cKDTree

from benchmarks.real.fusion import surface, voxel_of
from benchmarks.real.scenes import Thing

_NEAR = 3.0
"""Voxels. Farther apart, points do not show the same surface: the kitchen's drift is half a voxel to a voxel."""
_REACH = 10.0
"""Voxels. Of the other map, so much round the box is looked at."""


@dataclass(frozen=True)
class Overlap:
    """drift_m: the largest way that rigid alignment of the two maps moves a point of the thing, meters, at most as far
    as the alignment looks · seen_share: of the thing's points that the other map has a surface near, by the poses."""

    drift_m: float
    seen_share: float


@cache
def overlap(first: Path, second: Path, thing: Thing) -> Overlap:
    """Of two fused maps: point-to-plane ICP (Open3D) from where the poses say, of the surface in the thing's box."""
    voxel_m = voxel_of(second)
    near_m = _NEAR * voxel_m
    source, target = _cloud(first, thing, 0.0), _cloud(second, thing, _REACH * voxel_m)
    if len(target.points) == 0:
        return Overlap(0.0, 0.0)
    found = open3d.pipelines.registration.registration_icp(
        source,
        target,
        near_m,
        np.eye(4),
        open3d.pipelines.registration.TransformationEstimationPointToPlane(),
        open3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=50),
    )
    points = np.asarray(source.points)
    T = found.transformation
    moved = points @ T[:3, :3].T + T[:3, 3]
    target_tree = cKDTree(np.asarray(target.points))
    distances = target_tree.query(points)[0]
    drift = float(np.linalg.norm(moved - points, axis=1).max())
    return Overlap(min(drift, near_m), float((distances < near_m).mean()))


def _cloud(fused: Path, thing: Thing, margin: float) -> open3d.geometry.PointCloud:
    """The fused surface in the box grown by ``margin``, room frame."""
    rotation = thing.T_room_world.rotation.numpy()
    vertices, normals = (values @ rotation.T for values in surface(fused))
    inside = ((vertices > thing.low - margin) & (vertices < thing.high + margin)).all(axis=1)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(vertices[inside]))
    cloud.normals = open3d.utility.Vector3dVector(normals[inside])
    return cloud

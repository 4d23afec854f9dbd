"""Transforms, boxes and covariances between the map frame and the service. Plain numpy, no ROS.

Names say frame and direction: T_map_object carries points of the object's frame to the map frame. Similarities are 4x4.
Quaternions are x, y, z, w. All lengths in the map frame are meters (REP 103).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


def scale_of(T: Matrix) -> float:
    """The scale of a similarity: the cube root of its linear part's determinant."""
    return float(np.cbrt(np.linalg.det(T[:3, :3])))


def rotation_matrix(quaternion_xyzw: tuple[float, float, float, float]) -> Matrix:
    """Raises ValueError for a quaternion without a length."""
    q = np.asarray(quaternion_xyzw, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if not np.isfinite(length) or length < 1e-9:
        raise ValueError("a quaternion must be finite and not zero")
    x, y, z, w = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_xyzw(R: Matrix) -> tuple[float, float, float, float]:
    """Of a rotation matrix: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix (2000)."""
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], 0, 0, 0],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], 0, 0],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], 0],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    x, y, z, w = q if q[3] >= 0 else -q
    return float(x), float(y), float(z), float(w)


def rigid(quaternion: tuple[float, float, float, float], translation: tuple[float, float, float]) -> Matrix:
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(quaternion)
    T[:3, 3] = translation
    return T


@dataclass(frozen=True)
class Box:
    """An oriented box: its pose as a rigid 4x4 and its full edge lengths."""

    T_frame_box: Matrix
    size: tuple[float, float, float]

    def moved(self, T: Matrix) -> Box:
        """The same box in another frame; ``T`` may scale."""
        scale = scale_of(T)
        pose = T @ self.T_frame_box
        pose[:3, :3] /= scale
        width, depth, height = self.size
        return Box(pose, (scale * width, scale * depth, scale * height))

    def detection(self) -> dict[str, Any]:
        """As the service takes it."""
        return {
            "center": self.T_frame_box[:3, 3].tolist(),
            "size": list(self.size),
            "rotation_quaternion_xyzw": list(quaternion_xyzw(self.T_frame_box[:3, :3])),
        }


def field_from_map(dataparser_transforms: str) -> Matrix:
    """T_field_map of a field in its trainer's frame, from nerfstudio's dataparser_transforms.json; '': the identity.

    The file says that a point p of the dataset was trained at scale * (transform p), transform being 3x4.
    Raises ValueError for a file that does not hold these two.
    """
    if not dataparser_transforms:
        return np.eye(4)
    try:
        said = json.loads(Path(dataparser_transforms).read_bytes())
        T = np.eye(4)
        T[:3] = float(said["scale"]) * np.asarray(said["transform"], dtype=np.float64)[:3, :4]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{dataparser_transforms} does not hold a transform (3x4) and a scale: {error}") from error
    if not np.isfinite(T).all() or np.linalg.det(T[:3, :3]) <= 0:
        raise ValueError(f"{dataparser_transforms}: the transform is not a similarity")
    return T


@dataclass(frozen=True)
class ObjectPose:
    """Where an object stands. position and quaternion: of T_map_object, its scale taken out: the object's origin.

    scale: meters of one object unit · covariance: 6x6, of x, y, z and rotations about the map's fixed axes (REP 103),
    of the same origin. It does not depend on where the map's origin is. An object's origin that lies far from its
    surface is moved by the rotation's uncertainty.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    scale: float
    covariance: Matrix


def object_pose(T_object_field: Matrix, covariance: Matrix | None, T_field_map: Matrix) -> ObjectPose:
    """The pose in the map of a result's ``T_object_scene`` and its 7x7 covariance."""
    T_object_map = T_object_field @ T_field_map
    T_map_object = np.linalg.inv(T_object_map)
    scale = scale_of(T_map_object)
    R = T_map_object[:3, :3] / scale
    x, y, z = T_map_object[:3, 3].tolist()
    small = np.zeros((6, 6))
    if covariance is not None:
        small = pose_covariance(T_object_field, np.asarray(covariance), T_field_map)
    return ObjectPose((x, y, z), quaternion_xyzw(R), scale, small)


def pose_covariance(T_object_field: Matrix, covariance: Matrix, T_field_map: Matrix) -> Matrix:
    """The 6x6 of T_map_object from the 7x7 of T_object_field = (s, R, t), a left perturbation (omega, dt, d log s).

    It perturbs s e^d, exp(omega) R, t + dt. The inverse has the rotation Q = R^T and the origin p = -Q t / s. To first
    order it turns by -Q omega about the field's fixed axes, and p moves by -(Q / s) (dt + t x omega) - p d. Both are
    then carried to the map; the frame T_field_map itself has no uncertainty.
    """
    s = scale_of(T_object_field)
    Q = (T_object_field[:3, :3] / s).T
    t = T_object_field[:3, 3]
    J = np.zeros((6, 7))
    J[:3, :3] = -Q @ _cross(t) / s
    J[:3, 3:6] = -Q / s
    J[:3, 6] = Q @ t / s
    J[3:, :3] = -Q
    field_scale = scale_of(T_field_map)
    R_map_field = (T_field_map[:3, :3] / field_scale).T
    J[:3] = R_map_field @ J[:3] / field_scale
    J[3:] = R_map_field @ J[3:]
    return np.asarray(J @ covariance @ J.T, dtype=np.float64)


def _cross(v: Matrix) -> Matrix:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])

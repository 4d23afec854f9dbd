"""MSSD, MSPD and their recall, by the definitions of the BOP challenges.

Hodan et al., "BOP Challenge 2020 on 6D Object Localization", ECCV workshops 2020: an estimated pose P of an object with
vertices V and symmetries S has, against a true pose T,

    MSSD = min over s in S of max over x in V of | P x - T s x |, right below 0.05, 0.1, ..., 0.5 diameters,
    MSPD = min over s in S of max over x in V of | project(P x) - project(T s x) |, right below 5 r, ..., 50 r pixels,

with r = width / 640. A continuous symmetry is replaced by turns at which the vertex that is farthest from the axis
moves by 1 % of the diameter at most. The recall at a threshold is the share of the targets for which a right pose was
given; the average recall is the mean over the thresholds.

BOP's symmetries take prints into account: a cracker box has none. Depth alone shows no prints; :func:`surfaces_apart`
compares the two placed surfaces, whatever maps one onto the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Mesh = tuple[Array, NDArray[Any]]
"""Vertices (V, 3) and faces (F, 3)."""

MSSD_LIMITS: Array = np.arange(1, 11) * 0.05
"""Diameters."""
MSPD_LIMITS: Array = np.arange(1, 11) * 5.0
"""Pixels of an image that is 640 wide."""
_STEP = 0.01
"""Diameters: how far the farthest vertex moves between two turns about an axis."""
_COMPARED = 3000
_AT_ONCE = 3_000_000
"""Vertices times symmetries that are compared in one piece."""


def symmetries_of(info: Mapping[str, Any], vertices: Array) -> Array:
    """(S, 4, 4): what maps the object onto itself, the identity first. info: the object's entry in models_info.json ·
    vertices: (V, 3), the same unit."""
    discrete = [np.eye(4), *(np.array(each, np.float64).reshape(4, 4) for each in info.get("symmetries_discrete", ()))]
    turns = [np.eye(4)]
    for symmetry in info.get("symmetries_continuous", ()):
        axis, offset = (np.array(symmetry[key], np.float64) for key in ("axis", "offset"))
        turns += _turns(axis / np.linalg.norm(axis), offset, vertices, float(info["diameter"]))
    return np.stack([one @ turn for turn in turns for one in discrete])


def _turns(axis: Array, offset: Array, vertices: Array, diameter: float) -> list[Array]:
    """About the axis through ``offset``, but for the identity."""
    apart = vertices - offset
    reach = float(np.linalg.norm(apart - (apart @ axis)[:, None] * axis, axis=1).max())
    count = max(2, math.ceil(2.0 * math.pi * reach / (_STEP * diameter)))
    out = []
    for angle in 2.0 * math.pi * np.arange(1, count) / count:
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        turn[:3, 3] = offset - turn[:3, :3] @ offset
        out.append(turn)
    return out


def outermost(vertices: Array) -> Array:
    """The corners of the convex hull: the largest distance between two poses is attained at one of them."""
    try:
        return np.asarray(vertices[ConvexHull(vertices).vertices])
    except QhullError:
        return vertices


def mssd(estimate: Array, truth: Array, corners: Array, symmetries: Array) -> float:
    """Poses (4, 4), corners (V, 3) of the object: :func:`outermost` of its vertices do. The vertices' unit."""
    here = _moved(estimate, corners)
    return min(
        float(np.linalg.norm(there - here, axis=2).max(axis=1).min()) for there in _pieces(truth, corners, symmetries)
    )


def mspd(estimate: Array, truth: Array, vertices: Array, symmetries: Array, K: Array) -> float:
    """Pixels, by the camera's matrix K (3, 3). ``vertices`` are all of them: those inside of the hull may move farthest
    in the image."""
    here = _projected(_moved(estimate, vertices), K)
    pieces = _pieces(truth, vertices, symmetries)
    return min(float(np.linalg.norm(_projected(there, K) - here, axis=2).max(axis=1).min()) for there in pieces)


def surfaces_apart(estimate: Array, truth: Array, mesh: Mesh) -> float:
    """The largest distance of a vertex of either placed surface from the other one, of at most so many that are spread
    over the mesh's list, and the hull's. The vertices' unit."""
    import open3d

    vertices, faces = mesh
    some = np.concatenate([vertices[:: -(-len(vertices) // _COMPARED)], outermost(vertices)])
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), np.asarray(faces).astype(np.uint32))
    between = np.linalg.inv(truth) @ estimate
    moved = np.concatenate([_moved(pose, some) for pose in (between, np.linalg.inv(between))])
    return float(scene.compute_distance(open3d.core.Tensor(moved.astype(np.float32)), nthreads=1).numpy().max())


def _pieces(truth: Array, points: Array, symmetries: Array) -> list[Array]:
    """(s, P, 3) each: the points under the true pose after some of the symmetries."""
    step = max(1, _AT_ONCE // len(points))
    starts = range(0, len(symmetries), step)
    return [_moved(truth @ symmetries[start : start + step], points) for start in starts]


def _moved(poses: Array, points: Array) -> Array:
    """Poses (..., 4, 4) of points (P, 3): (..., P, 3)."""
    return np.asarray(points @ np.swapaxes(poses[..., :3, :3], -1, -2) + poses[..., None, :3, 3])


def _projected(points: Array, K: Array) -> Array:
    """Points behind the camera are infinitely far from everything."""
    seen = points @ K.T
    depth = np.where(seen[..., 2:] > 1e-9, seen[..., 2:], np.nan)
    return np.asarray(np.nan_to_num(seen[..., :2] / depth, nan=1e12))


def matched(errors: Array, scores: Sequence[float], limit: float) -> NDArray[np.bool_]:
    """(T,): which true poses of one object in one image were found. errors: (E, T), of estimates against truths.

    Estimates in the order of their scores each take the nearest truth that is left, if it is nearer than ``limit``.
    """
    found = np.zeros(errors.shape[1], np.bool_)
    for estimate in np.argsort(-np.asarray(scores), kind="stable"):
        left = np.where(found, np.inf, errors[estimate])
        if left.size and left.min() < limit:
            found[int(left.argmin())] = True
    return found

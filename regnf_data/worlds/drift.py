"""Errors of the camera's estimated poses, and where they carry what was measured."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from regnf_data.worlds.mesh import Array

LARGEST = 0.01
"""Deviation of the drift, a share of the distance to what is watched."""
_WATCHED_M = 1.5
_FREE_SHARE = 0.45
_CORRELATED = 0.12
"""Over what share of the walk errors are alike."""


def draw_drift(rng: np.random.Generator) -> float:
    """0 for nearly half of the worlds, else up to 1 %, small ones as often as large ones on a scale of ratios."""
    if rng.random() < _FREE_SHARE:
        return 0.0
    return float(LARGEST * 10.0 ** rng.uniform(-1.3, 0.0))


def drifted(poses: Array, drift: float, rng: np.random.Generator) -> Array:
    """(N, 4, 4): errors E of poses (N, 4, 4): the estimated pose is E T. They wander; a map's loop closures bound them.

    A place 1.5 m off is carried ``drift`` times 1.5 m astray, in the deviation; half of it by the turns.
    """
    errors = np.tile(np.eye(4), (len(poses), 1, 1))
    if drift == 0.0 or len(poses) < 2:
        return errors
    wide = max(_CORRELATED * len(poses), 1.0)
    wander = ndimage.gaussian_filter1d(rng.normal(size=(len(poses), 6)), wide, axis=0, mode="nearest")
    wander /= np.sqrt((wander**2).mean())
    turns = Rotation.from_rotvec(drift * np.sqrt(0.25) * wander[:, :3]).as_matrix()
    centers = poses[:, :3, 3]
    errors[:, :3, :3] = turns
    shifts = drift * _WATCHED_M * np.sqrt(0.25) * wander[:, 3:]
    errors[:, :3, 3] = centers - np.einsum("nij,nj->ni", turns, centers) + shifts
    return errors


def mean_motion(errors: Array, weights: Array, points: Array) -> tuple[Array, float]:
    """The rigid motion (4, 4) that carries points (P, 3) as the errors (N, 4, 4) do on the mean, by weights (N,), and

    the root mean square distance by which single errors carry them elsewhere.
    """
    share = weights / weights.sum()
    carried = np.einsum("nij,pj->npi", errors[:, :3, :3], points) + errors[:, None, :3, 3]
    mean = np.einsum("n,npi->pi", share, carried)
    spread = float(np.sqrt(np.einsum("n,npi->", share, (carried - mean) ** 2) / len(points)))
    source, target = points.mean(axis=0), mean.mean(axis=0)
    U, _, Vt = np.linalg.svd((points - source).T @ (mean - target))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    motion = np.eye(4)
    motion[:3, :3] = Vt.T @ flip @ U.T
    motion[:3, 3] = target - motion[:3, :3] @ source
    return motion, spread

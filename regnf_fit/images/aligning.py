"""Frames whose poses drift, aligned to one another on what they show of a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from regnf_core.geometry.box import OrientedBox
from regnf_data.recordings.recording import Frame
from regnf_fit.images.focus import region_frame, surface_in

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Floats = NDArray[np.float64]

_POINTS = 3000
"""Of a frame, at most."""
_REACH = 0.08
"""Of the region's longest side: surfaces that lie farther apart are not one."""
_ROUNDS = 15
_TOLERATED = 2.5
"""Deviations of the distances: pairs that lie farther apart tell nothing."""
_FEWEST = 150
_ALIKE = 0.5
"""Cosine between normals of one surface."""
_DETERMINED = 0.01
"""Of the pairs' weight, along a direction of motion: along those with less, a plane or a ball would slide or turn."""
_BETTER = 0.9
"""Of the distances that were left without it: an alignment that leaves more is not made."""
_MOVED_LEAST = 0.002
"""Of the region's longest side: motions that are less need not be said."""


@dataclass(frozen=True, eq=False)
class Aligned:
    """frames: the first as it was, the others moved where that is better · spread: a standard deviation of what
    distances between their surfaces are left, world unit, 0 for one frame · notes: which were moved."""

    frames: tuple[Frame, ...]
    spread: float
    notes: tuple[str, ...] = ()


def align_frames(frames: Sequence[Frame], region: OrientedBox) -> Aligned:
    """Every frame onto those before it: points to planes, by what they show in ``region``, world.

    A frame stays where its surfaces in the region do not tell how to move it (along a plane, about a ball's middle),
    where too few of them are seen by others, and where the others would not agree better with it.
    """
    if len(frames) == 1:
        return Aligned(tuple(frames), 0.0)
    T_region_world, half = region_frame(region)
    reach = _REACH * 2.0 * float(half.max())
    rng = np.random.default_rng(0)
    done, spreads, notes = [frames[0]], [0.0], []
    known = _drawn(surface_in(frames[0], T_region_world, half), rng)
    for frame in frames[1:]:
        points, normals = _drawn(surface_in(frame, T_region_world, half, reach), rng)
        motion, left = _motion(known, (points, normals), reach)
        if motion is not None:
            T = np.linalg.inv(T_region_world) @ motion @ T_region_world
            moved = float(np.linalg.norm(points @ motion[:3, :3].T + motion[:3, 3] - points, axis=1).mean())
            frame = replace(frame, T_world_camera=_rigid(T @ frame.T_world_camera))
            points, normals = points @ motion[:3, :3].T + motion[:3, 3], normals @ motion[:3, :3].T
            if moved > _MOVED_LEAST * 2.0 * half.max():
                notes.append(f"frame {frame.name} was moved by {moved:.2g} to match the previous frames")
        spreads.append(left)
        done.append(frame)
        known = np.concatenate([known[0], points]), np.concatenate([known[1], normals])
    return Aligned(tuple(done), max(spreads), tuple(notes))


def _drawn(surface: tuple[Floats, Floats], rng: np.random.Generator) -> tuple[Floats, Floats]:
    points, normals = surface
    chosen = rng.permutation(len(points))[:_POINTS]
    return points[chosen], normals[chosen]


def _rigid(T: Floats) -> Floats:
    u, _, vt = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = u @ vt
    return out


def _motion(known: tuple[Floats, Floats], own: tuple[Floats, Floats], reach: float) -> tuple[Floats | None, float]:
    """(4, 4) that carries points with normals ``own`` (P, 3) onto ``known``, None where they stay, and the deviation
    of the distances that are left."""
    if min(len(known[0]), len(own[0])) < _FEWEST:
        return None, 0.0
    from scipy.spatial import cKDTree  # the path of one frame does without

    tree = cKDTree(known[0])
    fit, check = ((own[0][k::2], own[1][k::2]) for k in range(2))
    T, within = np.eye(4), reach
    for _ in range(_ROUNDS):
        pairs = _pairs(tree, known[1], fit, T, within)
        if len(pairs.distances) < _FEWEST // 2:
            break
        step = _step(pairs)
        T = step @ T
        within = float(np.clip(2.0 * _TOLERATED * _deviation(pairs.apart), 0.1 * reach, within))
        if np.abs(step - np.eye(4)).max() < 1e-5 * reach:
            break
    before, after = (_pairs(tree, known[1], check, motion, reach) for motion in (np.eye(4), T))
    spreads = [_deviation(each.distances) for each in (before, after)]
    size = np.linalg.norm(own[0] @ T[:3, :3].T + T[:3, 3] - own[0], axis=1).max()
    better = spreads[1] < _BETTER * spreads[0] and len(after.distances) >= _BETTER * len(before.distances)
    return (T, spreads[1]) if better and size <= 2.0 * reach else (None, spreads[0])


@dataclass(frozen=True, eq=False)
class _Pairs:
    """points: (M, 3), moved · normals, own: (M, 3) of the surface they lie on, and their own, moved · distances: (M,)
    from its planes · apart: (M,) from its points."""

    points: Floats
    normals: Floats
    own: Floats
    distances: Floats
    apart: Floats


def _pairs(tree: cKDTree, normals: Floats, own: tuple[Floats, Floats], T: Floats, within: float) -> _Pairs:
    points, turned = own[0] @ T[:3, :3].T + T[:3, 3], own[1] @ T[:3, :3].T
    apart, index = tree.query(points, distance_upper_bound=within)
    found = np.isfinite(apart)
    found[found] = np.einsum("nc,nc->n", normals[index[found]], turned[found]) > _ALIKE
    there = normals[index[found]]
    distances = np.einsum("nc,nc->n", points[found] - tree.data[index[found]], there)
    return _Pairs(points[found], there, turned[found], distances, apart[found])


def _deviation(distances: Floats) -> float:
    return 1.4826 * float(np.median(np.abs(distances))) if len(distances) else 0.0


def _step(pairs: _Pairs) -> Floats:
    """(4, 4): one step of least squares, robust, along the directions of motion that the pairs determine."""
    scale = max(_TOLERATED * _deviation(pairs.distances), 1e-9)
    weight = np.clip(1.0 - (pairs.distances / scale) ** 2, 0.0, None) ** 2
    weight /= max(float(weight.sum()), 1e-9)
    middle = weight @ pairs.points
    arm = pairs.points - middle
    size = float(np.sqrt(weight @ np.einsum("nc,nc->n", arm, arm)))
    arm = arm / max(size, 1e-9)
    normal = pairs.normals + pairs.own
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    A, first, second = (np.hstack([np.cross(arm, n), n]) for n in (normal, pairs.normals, pairs.own))
    # The noise of two normals is independent: their product does not take it for curvature.
    product = (first * weight[:, None]).T @ second
    values, axes = np.linalg.eigh((product + product.T) / 2.0)
    axes, free = axes[:, values > _DETERMINED], axes[:, values <= _DETERMINED]
    A = A @ axes
    motion = axes @ np.linalg.lstsq((A * weight[:, None]).T @ A, -(A * weight[:, None]).T @ pairs.distances)[0]
    # Of the motions that serve alike, the one that turns least.
    cost = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    motion -= free @ np.linalg.lstsq(cost[:, None] * free, cost * motion)[0]
    w, t = motion[:3] / max(size, 1e-9), motion[3:]
    angle = float(np.linalg.norm(w))
    S = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]]) / max(angle, 1e-12)
    R = np.eye(3) + np.sin(angle) * S + (1.0 - np.cos(angle)) * S @ S
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, middle + t - R @ middle
    return out

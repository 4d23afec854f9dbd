"""An object's symmetries, measured on its exact mesh: turns that leave its surface where it is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.random_worlds.mesh import Array, ExactScene, Mesh
from benchmarks.random_worlds.models import Model

EXACT, NEAR = 0.01, 0.03
"""How far off, in diameters, 99 % of the surface may be after a symmetry's turn, and after a near one's."""
_ORDERS = (2, 3, 4, 5, 6, 8)
_ANY_DEG = (7.0, 13.0, 22.5, 29.0, 51.0)
_LARGEST_GROUP = 48
_SAME = 0.1
_POINTS, _FEW = 800, 80


def measure_symmetries(model: Model) -> tuple[dict[str, list[Any]], dict[str, list[Any]]]:
    """The symmetries and those that nearly hold, in BOP's form (see ``Symmetries.from_dict``), in the model's frame.

    Tried are turns about x, y, z and the principal axes, through the centroid of the area and the middle of the bounds,
    and what follows from those found.
    """
    deviation = _Deviation(model)
    turns: list[_Tried] = []
    for axis, center in itertools.product(_axes(model.surface), _centers(model.mesh)):
        free = max(deviation.of(_turn(axis, center, math.radians(angle))) for angle in _ANY_DEG[:1])
        if free <= NEAR:
            free = max(deviation.of(_turn(axis, center, math.radians(angle))) for angle in _ANY_DEG)
        turns.append(_Tried(free, axis, center, None))
        for order in _ORDERS:
            T = _turn(axis, center, 2.0 * math.pi / order)
            turns.append(_Tried(deviation.of(T), axis, center, T))
    exact, near = (_in_words(turns, deviation, tolerance) for tolerance in (EXACT, NEAR))
    return exact, near


class _Tried(NamedTuple):
    """A turn T, or all turns where T is None, about an axis (3,) through a center (3,)."""

    deviation: float
    axis: Array
    center: Array
    T: Array | None


class _Deviation:
    """How far, in diameters, a turn carries the surface from the surface: 99 % of it lies nearer."""

    def __init__(self, model: Model) -> None:
        self._scene, self._size = ExactScene([model.mesh]), model.diameter
        self.points = model.surface[:: max(1, len(model.surface) // _POINTS)]

    def of(self, T: Array) -> float:
        """Of T (4, 4) and its inverse; a few points tell most turns that are none."""
        for points in (self.points[:: _POINTS // _FEW], self.points):
            both = np.concatenate([_carried(T, points), _carried(np.linalg.inv(T), points)])
            deviation = float(np.quantile(self._scene.distance(both), 0.99)) / self._size
            if deviation > 2.0 * NEAR:
                return deviation
        return deviation


def _in_words(turns: Sequence[_Tried], deviation: _Deviation, tolerance: float) -> dict[str, list[Any]]:
    """At most one free axis, and the group of the other turns."""
    holding = [one for one in turns if one.deviation <= tolerance]
    free = min((one for one in holding if one.T is None), key=lambda one: one.deviation, default=None)
    found = [one.T for one in sorted(holding, key=lambda one: one.deviation) if one.T is not None]
    if free is not None:  # beside a free axis, turns that reverse it
        found = [T for T in found if float(free.axis @ (T[:3, :3] @ free.axis)) < -0.99][:1]
    group = _closure(found, deviation.points)
    return {
        "symmetries_discrete": [T.ravel().tolist() for T in group if deviation.of(T) <= 1.5 * tolerance],
        "symmetries_continuous": [] if free is None else [{"axis": free.axis.tolist(), "offset": free.center.tolist()}],
    }


def _axes(points: Array) -> list[Array]:
    """x, y, z and the principal axes that differ from them."""
    axes = list(np.eye(3))
    _, _, principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    axes += [axis for axis in principal if max(abs(float(axis @ other)) for other in axes) < 0.999]
    return axes


def _centers(mesh: Mesh) -> list[Array]:
    _, areas = mesh.normals_and_areas
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    return [(areas[:, None] * middles).sum(axis=0) / areas.sum(), mesh.bounds.mean(axis=0)]


def _turn(axis: Array, center: Array, angle: float) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
    T[:3, 3] = center - T[:3, :3] @ center
    return T


def _carried(T: NDArray[Any], points: Array) -> Array:
    carried: Array = points @ T[:3, :3].T + T[:3, 3]
    return carried


def _closure(found: list[Array], points: Array) -> list[Array]:
    """All products of the turns, each once, without the identity."""
    group: list[Array] = [np.eye(4)]
    some = points[:: max(1, len(points) // 50)]
    apart = _SAME * float(np.ptp(points, axis=0).max())

    def is_new(T: Array) -> bool:
        return all(np.abs(_carried(T, some) - _carried(G, some)).max() > apart for G in group)

    queue = list(found)
    while queue and len(group) < _LARGEST_GROUP:
        T = queue.pop(0)
        if is_new(T):
            group.append(T)
            queue += [T @ G for G in found]
    return group[1:]

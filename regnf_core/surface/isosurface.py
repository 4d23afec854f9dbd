"""The zero level of a field as a triangle mesh: marching cubes on the cells that the surface may pass through.

Blocks of cells are halved level by level, and those too far from the surface for their size are dropped. From the
cells that remain, the surface is followed into their neighbors. So the field is evaluated at few more places than the
corners of these cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import igl
import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.fields.observation import SdfField

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Progress = Callable[[int], None]
"""Called with the number of points evaluated so far."""

MAX_RESOLUTION = 1024
_COARSEST_BLOCK = 32
_PROBES = 4096
_CORNERS: Ints = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
_FACES = [
    (side * np.eye(3, dtype=np.int64)[axis], np.flatnonzero(_CORNERS[:, axis] == (side + 1) // 2))
    for axis in range(3)
    for side in (-1, 1)
]
"""The step to each neighbor of a cell, and the corners shared with it."""
_CHUNK = 1 << 16


@dataclass(frozen=True)
class Surface:
    """A mesh: vertices (V, 3) and unit normals (V, 3) towards free space, own frame; faces (F, 3).

    A face's corners are anticlockwise seen from free space.
    """

    vertices: Floats
    faces: Ints
    normals: Floats


@dataclass(frozen=True)
class Lattice:
    """Nodes at low + step (i, j, k), 0 <= i < counts: cubic cells that cover a box. low: (3,) · counts: (3,)."""

    low: Floats
    step: float
    counts: Ints

    @classmethod
    def over(cls, field: SdfField, resolution: int) -> Lattice:
        """``resolution`` cells along the longest edge of the field's bounds. Raises InvalidInputError."""
        if not 2 <= resolution <= MAX_RESOLUTION:
            raise InvalidInputError(f"the resolution must be 2 to {MAX_RESOLUTION}", reason="INVALID_OPTIONS")
        low, high = field.bounds.numpy()
        step = float((high - low).max()) / resolution
        return cls(low, step, np.ceil((high - low) / step - 1e-9).astype(np.int64) + 1)

    def points_of(self, nodes: Ints | Floats) -> Floats:
        """The points (N, 3) of nodes (N, 3), given by their indices; fractions are allowed."""
        points: Floats = self.low + self.step * nodes
        return points


def extract_surface(field: SdfField, resolution: int = 128, progress: Progress | None = None) -> Surface:
    """The surface of ``field`` within its bounds, ``resolution`` cells along the longest edge (2 to 1024).

    Raises NoSurfaceError where there is none, and InvalidInputError (FIELD_NOT_FINITE).
    """
    lattice = Lattice.over(field, resolution)
    evaluator = _Evaluator(field, progress)
    cells = _cells_near_surface(evaluator, lattice, evaluator.steepness(lattice))
    vertices, faces = _marching_cubes(_follow_surface(evaluator, lattice, cells))
    if len(faces) == 0:
        raise NoSurfaceError("the field has no surface within its bounds", reason="NO_SURFACE_IN_OBJECT")
    normals = evaluator.normals(vertices)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    along = (np.cross(b - a, c - a) * normals[faces].sum(axis=1)).sum(axis=1)
    # the corners' order does not say which side is free: all are reversed when most disagree with the normals
    return Surface(vertices, faces[:, ::-1].copy() if along.sum() < 0 else faces, normals)


class _Evaluator:
    """Evaluates the field, and reports how many points it has evaluated."""

    def __init__(self, field: SdfField, progress: Progress | None) -> None:
        self._field = field
        self._progress = progress
        self._points = 0

    def distances(self, points: Floats) -> Floats:
        """(N,) signed distances at points (N, 3). Raises InvalidInputError (FIELD_NOT_FINITE)."""
        found = [np.zeros(0)]
        for start in range(0, len(points), _CHUNK):
            chunk = torch.from_numpy(points[start : start + _CHUNK])
            found.append(self._field.signed_distance(chunk).double().cpu().numpy())
            self._count(len(chunk))
        values: Floats = np.concatenate(found)
        if not np.isfinite(values).all():
            raise InvalidInputError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")
        return values

    def normals(self, points: Floats) -> Floats:
        """(N, 3) unit gradients at points (N, 3)."""
        gradient = self._field.signed_distance_and_gradient(torch.from_numpy(points))[1].double().cpu().numpy()
        self._count(len(points))
        normals: Floats = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        return normals

    def steepness(self, lattice: Lattice) -> float:
        """How much faster than a distance the field may change, from the gradient at random places; at least 1."""
        nodes = np.random.default_rng(0).random((_PROBES, 3)) * (lattice.counts - 1)
        points = torch.from_numpy(lattice.points_of(nodes))
        gradient = self._field.signed_distance_and_gradient(points)[1]
        self._count(_PROBES)
        return max(1.0, float(gradient.norm(dim=1).max()))

    def _count(self, points: int) -> None:
        self._points += points
        if self._progress is not None:
            self._progress(self._points)


def _cells_near_surface(evaluator: _Evaluator, lattice: Lattice, steepness: float) -> Ints:
    """(C, 3) lowest nodes of the cells that the surface may pass through."""
    cells = lattice.counts - 1
    size = _COARSEST_BLOCK
    per_axis = [np.arange(0, n, size) for n in cells]
    blocks = np.stack(np.meshgrid(*per_axis, indexing="ij"), axis=-1).reshape(-1, 3)
    while size > 1:
        reach = steepness * lattice.step * size * 3**0.5 / 2.0
        near = np.abs(evaluator.distances(lattice.points_of(blocks + size / 2.0))) <= reach
        size //= 2
        blocks = (blocks[near, None] + size * _CORNERS).reshape(-1, 3)
        blocks = blocks[(blocks < cells).all(axis=1)]
    return blocks


@dataclass(frozen=True)
class _Crossed:
    """The cells (C, 8) that the surface passes through, as indices of nodes with points (N, 3) and distances (N,)."""

    corners: Ints
    points: Floats
    distances: Floats


def _follow_surface(evaluator: _Evaluator, lattice: Lattice, cells: Ints) -> _Crossed:
    """Follow the surface from cell to cell, also into cells that were dropped before."""
    flat, values = np.zeros(0, np.int64), np.zeros(0)
    seen = np.zeros(0, np.int64)
    crossed = [np.zeros((0, 8), np.int64)]
    while len(cells):
        seen = np.union1d(seen, _flat_index(lattice, cells))
        corners = _flat_index(lattice, cells[:, None] + _CORNERS)
        new = np.setdiff1d(corners, flat)
        order = np.argsort(np.concatenate((flat, new)))
        values = np.concatenate((values, evaluator.distances(lattice.points_of(_unflattened(lattice, new)))))[order]
        flat = np.concatenate((flat, new))[order]
        inside = values[np.searchsorted(flat, corners)] < 0
        crossed.append(corners[inside.any(axis=1) & ~inside.all(axis=1)])
        found = [np.zeros((0, 3), np.int64)]
        for step, face in _FACES:
            through = inside[:, face].any(axis=1) & ~inside[:, face].all(axis=1)
            found.append(cells[through] + step)
        beyond = np.unique(np.concatenate(found), axis=0)
        beyond = beyond[((beyond >= 0) & (beyond < lattice.counts - 1)).all(axis=1)]
        cells = beyond[~np.isin(_flat_index(lattice, beyond), seen)]
    kept, corners = np.unique(np.concatenate(crossed), return_inverse=True)
    at = np.searchsorted(flat, kept)
    return _Crossed(corners.reshape(-1, 8), lattice.points_of(_unflattened(lattice, kept)), values[at])


def _flat_index(lattice: Lattice, nodes: Ints) -> Ints:
    flat: Ints = nodes @ np.array([lattice.counts[1] * lattice.counts[2], lattice.counts[2], 1])
    return flat


def _unflattened(lattice: Lattice, flat: Ints) -> Ints:
    return np.stack(np.unravel_index(flat, tuple(lattice.counts)), axis=1)


def _marching_cubes(crossed: _Crossed) -> tuple[Floats, Ints]:
    if len(crossed.corners) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    # a node exactly on the surface would count as inside for one cell and as outside for the next
    distances = np.where(crossed.distances == 0.0, np.finfo(np.float64).tiny, crossed.distances)
    found = igl.marching_cubes(distances, crossed.points, np.ascontiguousarray(crossed.corners, np.int64))
    return found[0], found[1]

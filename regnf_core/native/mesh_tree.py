"""A triangle mesh for compiled code, with its hierarchy: closest points, winding numbers, and signed distances. See
regnf_core/native/mesh.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.native.library import Steps
from regnf_core.native.steps import Kept, NativeModel, in_threads, room

_SLOTS, _NODE_NUMBERS = 8, 26
"""Triangles of a leaf and children of a node; four-byte numbers that a node has for each child. As in mesh_tree.h."""
_ADDRESS = ctypes.c_void_p
_ARRAYS = ("vertices", "faces", "nodes", "leaves", "order")

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


class _Mesh(ctypes.Structure):
    """regnf_mesh of field.h, member by member."""

    _fields_ = (
        ("triangles", ctypes.c_int64),
        *((name, _ADDRESS) for name in _ARRAYS),
        ("inside_above", ctypes.c_double),
        ("touching", ctypes.c_double),
        *((name, _ADDRESS) for name in ("of_faces", "of_vertices", "across")),
    )


class MeshTree:
    """A mesh's hierarchy, which is built here, in about a second for a million triangles; 150 bytes for each of them.

    vertices: (V, 3) finite · faces: (F, 3) indices of them, at least one · inside_above: the winding number above which
    a point is inside · touching: the distance, in units of the vertices, below which a point is on the surface.
    Compiled code has the mesh about the origin and within -1 and 1: the unit is a power of two, so that no number is
    rounded for it.
    """

    def __init__(self, steps: Steps, vertices: Array, faces: Numbers, inside_above: float, touching: float) -> None:
        self.steps = steps
        corners = vertices[faces.reshape(-1)]
        low, high = corners.min(axis=0), corners.max(axis=0)
        self.origin: Array = low + 0.5 * (high - low)
        self.unit = float(np.ldexp(1.0, int(np.clip(np.frexp((high - low).max())[1] - 1, -1000, 1000))))
        self._count = len(faces)
        leaves = -(-self._count // _SLOTS)
        self._arrays = {
            "vertices": torch.from_numpy((vertices - self.origin) / self.unit),
            "faces": torch.from_numpy(faces if faces.flags.writeable else faces.copy()),
            "nodes": room(steps.mesh_nodes(self._count), _NODE_NUMBERS, _SLOTS),
            "leaves": room(leaves, 9, _SLOTS, dtype=torch.float64),
            "order": room(leaves, _SLOTS, dtype=torch.int32),
        }
        self._levels = {"inside_above": inside_above, "touching": touching / self.unit}
        self.has_normals = False
        self._mesh = self._described()
        if steps.grow_mesh(self._mesh.address):
            raise MemoryError("not enough memory for the hierarchy of a mesh")

    def _described(self, **normals: Tensor) -> Kept:
        return Kept(_Mesh, triangles=self._count, **self._arrays, **self._levels, **normals)

    def use_normals(self, of_faces: Array, of_vertices: Array, across: Numbers) -> None:
        """From now on the sides of signed distances are those of these normals, where they are decided.

        of_faces: (F, 3) · of_vertices: (V, 3) · across: (F, 3), the triangle beyond the edge opposite to each corner.
        """
        given = {"of_faces": of_faces, "of_vertices": of_vertices, "across": across}
        self._mesh = self._described(**{name: torch.from_numpy(one) for name, one in given.items()})
        self.has_normals = True

    def closest(self, points: Array) -> tuple[Array, Numbers, Array]:
        """Distances (N,) from points (N, 3), the closest triangles (N,), and the closest places on them (N, 3)."""
        squares, closest, triangles = np.empty(len(points)), np.empty((len(points), 3)), np.empty(len(points), np.int64)
        self._ask(self.steps.mesh_closest, points, [squares, triangles, closest])
        return np.sqrt(squares) * self.unit, triangles, closest * self.unit + self.origin

    def winding_number(self, points: Array) -> Array:
        """(N,) at points (N, 3): near triangles exactly, those far away by a series, with an error below 0.01."""
        number = np.empty(len(points))
        self._ask(self.steps.mesh_winding, points, [number])
        return number

    def signed_distance_and_gradient(self, points: Array) -> tuple[Array, NDArray[np.float32]]:
        """(N,) and (N, 3) at points (N, 3); NaN where a point is not finite."""
        distance, gradient = np.empty(len(points)), np.empty((len(points), 3), np.float32)
        self._ask(self.steps.mesh_at, points, [distance, gradient])
        return distance * self.unit, gradient

    def model(self) -> NativeModel:
        """For a compiled minimization, in the vertices' frame and unit."""
        turn, shift = np.eye(3).ravel() / self.unit, -self.origin / self.unit
        return NativeModel(self.steps.mesh, self._mesh, tuple(turn.tolist()), tuple(shift.tolist()), self.unit)

    def _ask(self, function: Callable[..., None], points: Array, results: Sequence[NDArray[np.generic]]) -> None:
        """Fill results (N, ...) at points (N, 3), in as many threads as torch has."""
        places = np.ascontiguousarray((points - self.origin) / self.unit)
        mesh = self._mesh

        def part(begin: int, end: int) -> None:
            function(
                mesh.address, places[begin:].ctypes.data, end - begin, *(one[begin:].ctypes.data for one in results)
            )

        in_threads(part, len(points))

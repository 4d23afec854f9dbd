"""A triangle mesh with fewer triangles: vertices that share a cell of a grid become one (Rossignac, Borrel 1993).

It takes a second for a million triangles, whatever their shape, and needs neither a closed nor a clean mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_WIDER = 1.15
"""Factor of the cells' edge while there are too many triangles."""
_MOST_CELLS = 1 << 20
"""Along each axis: three indices of cells fit into one 64-bit number."""


@dataclass(frozen=True)
class Triangles:
    """vertices: (V, 3) · faces: (F, 3) · normals: (V, 3) or None, flat then · colors: (V, 3) in [0, 1] or None."""

    vertices: Floats
    faces: Ints
    normals: Floats | None = None
    colors: Floats | None = None


def at_most(mesh: Triangles, triangles: int, vertices: int) -> Triangles:
    """``mesh`` itself if it has no more of both, else one whose vertices are means over cells as small as possible.

    The cells' edge is the first of a growing series that leaves few enough; it begins at what the area suggests.
    """
    if len(mesh.faces) <= triangles and len(mesh.vertices) <= vertices:
        return mesh
    edge = _first_edge(mesh, min(triangles, 2 * vertices))
    while True:
        smaller = clustered(mesh, edge)
        if len(smaller.faces) <= triangles and len(smaller.vertices) <= vertices:
            return smaller
        edge *= _WIDER


def clustered(mesh: Triangles, edge: float) -> Triangles:
    """The mesh with one vertex, the mean, for each cell of edge length ``edge``; triangles without area are gone."""
    low = mesh.vertices.min(axis=0)
    cells = np.floor((mesh.vertices - low) / edge).astype(np.int64)
    flat = (cells[:, 0] * _MOST_CELLS + cells[:, 1]) * _MOST_CELLS + cells[:, 2]
    _, cluster, counts = np.unique(flat, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    faces = cluster[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    means = Triangles(
        _means(mesh.vertices, cluster, counts),
        faces[np.sort(first)],
        None if mesh.normals is None else _unit(_means(mesh.normals, cluster, counts)),
        None if mesh.colors is None else _means(mesh.colors, cluster, counts),
    )
    return used_alone(means)


def used_alone(mesh: Triangles) -> Triangles:
    """The mesh without the vertices that no triangle has."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    if len(used) == len(mesh.vertices):
        return mesh
    normals, colors = (None if part is None else part[used] for part in (mesh.normals, mesh.colors))
    return replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3), normals=normals, colors=colors)


def _first_edge(mesh: Triangles, triangles: int) -> float:
    """A surface leaves about two triangles for each square of the cells' edge; no more cells than can be counted."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    return float(max((area / triangles) ** 0.5, longest / (_MOST_CELLS - 1), np.finfo(np.float64).tiny))


def _means(values: Floats, cluster: Ints, counts: Ints) -> Floats:
    """(C, 3) means of values (V, 3) over the clusters."""
    sums = [np.bincount(cluster, values[:, axis], len(counts)) for axis in range(3)]
    means: Floats = np.stack(sums, axis=1) / counts[:, None]
    return means


def _unit(vectors: Floats) -> Floats:
    found: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return found

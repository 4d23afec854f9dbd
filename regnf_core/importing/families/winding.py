"""The generalized winding number of a mesh (Jacobson et al. 2013), and places just before its faces to ask it at."""

from __future__ import annotations

import igl
import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, Int64Array

_BEFORE = 1e-4
"""How far before its face a place lies, in the mesh's diagonals."""


def winding_number(vertices: Float64Array, faces: Int64Array, places: Float64Array) -> Float64Array:
    """(N,) at places (N, 3). vertices: (V, 3), faces: (F, 3)."""
    tree = igl.FastWindingNumberBVH()
    tree.init(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
    values: Float64Array = np.asarray(tree.winding_number(np.ascontiguousarray(places)), dtype=np.float64).reshape(-1)
    return values


def areas(vertices: Float64Array, faces: Int64Array) -> Float64Array:
    """(F,): twice the area of each face."""
    length: Float64Array = np.linalg.norm(_crossed(vertices, faces), axis=1)
    return length


def places_before(
    vertices: Float64Array, faces: Int64Array, chosen: Int64Array, random: np.random.Generator
) -> Float64Array:
    """(N, 3): a place just before each of the chosen faces (N,), uniform over it."""
    a, b = random.random((2, len(chosen), 1))
    a, b = np.where(a + b > 1.0, 1.0 - a, a), np.where(a + b > 1.0, 1.0 - b, b)
    few = faces[chosen]
    corner, first, second = (vertices[few[:, i]] for i in range(3))
    normal = _crossed(vertices, few)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    on_face = corner + a * (first - corner) + b * (second - corner)
    places: Float64Array = on_face + _BEFORE * diagonal * normal / length
    return places


def _crossed(vertices: Float64Array, faces: Int64Array) -> Float64Array:
    corner, first, second = (vertices[faces[:, i]] for i in range(3))
    crossed: Float64Array = np.cross(first - corner, second - corner)
    return crossed

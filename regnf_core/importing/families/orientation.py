"""Faces that are turned round among their neighbors: exporters and repairs leave such, each a dent in the field."""

from __future__ import annotations

import igl
import numpy as np

from regnf_core.importing.meshes.geometry import Float64Array, Int64Array

_FEW = 0.002
"""Share of the edges that may disagree: less is not worth a change."""
_FEWER = 0.5
"""Of the edges that disagree so many may be left, or the faces stay as they are."""


def agreeing(vertices: Float64Array, faces: Int64Array) -> tuple[Int64Array, tuple[str, ...]]:
    """The faces (F, 3), each turned to agree with most of its patch, and what was done."""
    before = _disagreeing(faces)
    if before <= _FEW:
        return faces, ()
    oriented, patch = igl.bfs_orient(np.ascontiguousarray(faces))
    patch = np.asarray(patch).reshape(-1)
    kept = (oriented == faces).all(axis=1)
    corner, first, second = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(first - corner, second - corner), axis=1)
    for_it = np.bincount(patch, np.where(kept, area, -area))
    turned = kept == (for_it[patch] < 0.0)
    found = np.where(turned[:, None], faces[:, ::-1], faces)
    if not turned.any() or _disagreeing(found) > _FEWER * before:
        return faces, ()
    share = 100.0 * float(area[turned].sum() / area.sum())
    return found, (f"{share:.2g} % of its surface was turned round, to agree with what is beside it",)


def _disagreeing(faces: Int64Array) -> float:
    """Share of the edges that two faces run through in one direction."""
    start, end = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    count = np.unique(start * (int(faces.max()) + 1) + end, return_counts=True)[1]
    return float((count > 1).sum() / len(count))

"""Triangles as an exact distance field: welded, without triangles of no area, normals towards free space."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from regnf_core.importing.cost.budget import require_within
from regnf_core.importing.cost.mesh_work import mesh_seconds
from regnf_core.importing.families.color.head import with_values
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.facing import SAMPLES, Asked, Facing, facing_of
from regnf_core.importing.families.inverted_parts import PLACES, facing_outward
from regnf_core.importing.families.orientation import agreeing
from regnf_core.importing.families.shared import refuse_other_entries, require_family, shared_entries
from regnf_core.importing.meshes.geometry import Float64Array, Geometry, Int64Array, malformed
from regnf_core.importing.upload_description import UploadDescription

_MARGIN = 0.05
"""How far the bounds reach beyond the mesh, in its diagonals: free space from which its surface can be seen."""
_FAR = 1e4
"""Coordinates beyond this many diagonals leave float32 too few digits."""


def mesh_field(
    geometry: Geometry, origin: str, overrides: UploadDescription, family: str = "mesh", work_s: float = math.inf
) -> ConvertedField:
    """The exact distance to triangles. ``origin``: what they come from, for the report. Raises as ``convert_mesh``."""
    require_family(overrides, family)
    refuse_other_entries(overrides, family)
    _check(geometry)
    vertices, faces, kept = welded(geometry.vertices, geometry.faces)
    require_within(mesh_seconds(vertices, faces, 3 * SAMPLES + PLACES), work_s)
    asked = "object" if overrides.sign == -1 else overrides.as_  # who turns the sign round means the turned faces
    facing = oriented(vertices.astype(np.float64), faces, asked)
    faces = facing.faces
    low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
    diagonal = float(np.linalg.norm(high - low))
    bounds = [(low - _MARGIN * diagonal).tolist(), (high + _MARGIN * diagonal).tolist()]
    loose = _open_edge_share(faces, len(vertices))
    why = (
        f"{origin}: {len(faces)} triangles, {len(vertices)} vertices",
        "watertight"
        if loose == 0.0
        else f"not watertight, {100 * loose:.2g} % of its edges are open: the winding number decides what is inside",
        *facing.why,
        *(f"ignored: {what}" for what in geometry.left_out),
    )
    converted = ConvertedField(
        family,
        why,
        {
            "kind": "mesh",
            "source": {"family": family},
            "inside_above": facing.level,
            **shared_entries(overrides, bounds),
        },
        {"vertices": vertices, "faces": np.ascontiguousarray(faces, dtype=np.int32)},
        (*facing.warnings, *_warnings(max(np.abs(low).max(), np.abs(high).max()) / diagonal)),
    )
    colors = None if overrides.color.keep is False else geometry.colors
    return with_values(converted, lambda: None if colors is None else colors[kept].astype(np.float16))


def oriented(vertices: Float64Array, faces: Int64Array, asked: Asked = None) -> Facing:
    """The faces (F, 3) of welded triangles turned towards free space, as far as their places tell. vertices: (V, 3)."""
    faces, agreed = agreeing(vertices, faces)
    facing = facing_of(vertices, faces, asked)
    faces, parts = facing_outward(vertices, facing.faces, facing.free)
    return replace(facing, faces=faces, why=(*agreed, *facing.why, *parts))


def _check(geometry: Geometry) -> None:
    if not np.isfinite(geometry.vertices).all() or np.abs(geometry.vertices).max(initial=0.0) > 1e30:
        raise malformed("the mesh has a vertex that is not a finite number")
    if geometry.faces.min() < 0 or geometry.faces.max() >= len(geometry.vertices):
        raise malformed("a face names a vertex that does not exist")


def welded(
    vertices: Float64Array, faces: Int64Array
) -> tuple[npt.NDArray[np.float32], Int64Array, npt.NDArray[np.int64]]:
    """Vertices at one place are one, those of no face and triangles without area are dropped.

    Also the number, in the file, of each vertex that is left.
    """
    used, faces = np.unique(faces, return_inverse=True)
    places = vertices[used].astype(np.float32) + np.float32(0.0)  # adding zero makes -0.0 plain
    rows = np.ascontiguousarray(places).view([("", np.float32)] * 3).reshape(-1)
    _, first, number = np.unique(rows, return_index=True, return_inverse=True)
    corners = number.reshape(-1)[faces.reshape(-1, 3)]
    a, b, c = (places[first][corners[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = corners[area > 0.0]
    if len(corners) == 0:
        raise malformed("no triangle of the mesh has an area")
    kept, corners = np.unique(corners, return_inverse=True)
    return places[first][kept], corners.reshape(-1, 3), used[first][kept]


def _open_edge_share(faces: Int64Array, vertices: int) -> float:
    """Share of the directed edges that no neighbor runs through the other way, exactly once."""
    start, end = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    forward, count = np.unique(start * vertices + end, return_counts=True)
    single = forward[count == 1]
    matched = np.isin(single // vertices + (single % vertices) * vertices, single, assume_unique=True)
    return float(1.0 - matched.sum() / len(start))


def _warnings(reach: float) -> tuple[str, ...]:
    if reach <= _FAR:
        return ()
    text = f"its coordinates reach {reach:.0f} diagonals from the origin, which costs digits: move it there"
    return (f"FAR_FROM_ORIGIN: {text}",)

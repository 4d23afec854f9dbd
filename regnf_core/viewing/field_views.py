"""Drawing a stored field: its surface as a mesh in two levels of detail, and a picture."""

from __future__ import annotations

import io
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from regnf_core.errors import RegnfError
from regnf_core.field_notes import FieldViews
from regnf_core.fields.build import open_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import SdfField, has_color
from regnf_core.schema.safe_format import read_description
from regnf_core.schema.similarity import local_origin
from regnf_core.surface.exporting import glb_of
from regnf_core.surface.isosurface import extract_surface
from regnf_core.viewing.field_picture import field_picture


def mesh_file(
    vertices: NDArray[Any], faces: NDArray[Any], normals: NDArray[Any] | None = None, colors: NDArray[Any] | None = None
) -> bytes:
    """The GLB of a mesh. vertices, normals: (V, 3) · faces: (F, 3) · colors: (V, 3) in [0, 1]."""
    origin = np.array(local_origin([vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()]) or (0.0, 0.0, 0.0))
    levels = None if colors is None else np.rint(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices - origin, faces, vertex_normals=normals, vertex_colors=levels, process=False)
    return glb_of(mesh, origin, normals is not None)


# A triangle mesh with fewer triangles: vertices that share a cell of a grid become one (Rossignac, Borrel 1993).
#
# It takes a second for a million triangles, whatever their shape, and needs neither a closed nor a clean mesh.

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_WIDER = 1.15
"""Factor of the cells' edge while there are too many triangles."""
_MOST_CLUSTERS = 1 << 20
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
    # a surface leaves about two triangles for each square of the cells' edge; no more cells than can be counted
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    least = float(np.ptp(mesh.vertices, axis=0).max()) / (_MOST_CLUSTERS - 1)
    edge = max((area / min(triangles, 2 * vertices)) ** 0.5, least, float(np.finfo(np.float64).tiny))
    while True:
        smaller = clustered(mesh, edge)
        if len(smaller.faces) <= triangles and len(smaller.vertices) <= vertices:
            return smaller
        edge *= _WIDER


def clustered(mesh: Triangles, edge: float) -> Triangles:
    """The mesh with one vertex, the mean, for each cell of edge length ``edge``; triangles without area are gone."""
    low = mesh.vertices.min(axis=0)
    cells = np.floor((mesh.vertices - low) / edge).astype(np.int64)
    flat = (cells[:, 0] * _MOST_CLUSTERS + cells[:, 1]) * _MOST_CLUSTERS + cells[:, 2]
    _, cluster, counts = np.unique(flat, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    faces = cluster[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)

    def means(values: Floats) -> Floats:
        return np.stack([np.bincount(cluster, values[:, axis], len(counts)) for axis in range(3)], 1) / counts[:, None]

    normals = None if mesh.normals is None else means(mesh.normals)
    if normals is not None:
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    colors = None if mesh.colors is None else means(mesh.colors)
    return used_alone(Triangles(means(mesh.vertices), faces[np.sort(first)], normals, colors))


def used_alone(mesh: Triangles) -> Triangles:
    """The mesh without the vertices that no triangle has."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    if len(used) == len(mesh.vertices):
        return mesh
    normals, colors = (None if part is None else part[used] for part in (mesh.normals, mesh.colors))
    return replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3), normals=normals, colors=colors)


# The surface of a field as people see it: a mesh with a bounded number of triangles, in two levels of detail.

FINE_TRIANGLES, FINE_VERTICES = 200_000, 150_000
COARSE_TRIANGLES, COARSE_VERTICES = 30_000, 22_500
_COARSE_CELLS, _MOST_CELLS = 64, 224
"""Cells along the longest edge of the bounds."""
_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class DisplayMeshes:
    """fine: what a person looks at · coarse: what arrives and moves fast; None where ``fine`` is that small itself."""

    fine: Triangles
    coarse: Triangles | None


class TooSlowError(RegnfError):
    """The field is too slow to be drawn in good time."""

    reason = "FIELD_VIEW_NOT_FOUND"


def display_meshes(field: SdfField, budget_s: float) -> DisplayMeshes:
    """The field's surface, in its own frame and unit, with vertex colors where the field has colors.

    Of a mesh its own triangles are shown, without normals, that is flat. Of other fields the surface is extracted:
    with as many cells as ``budget_s`` processor seconds allow, by the time that a coarse one takes. Raises TooSlowError
    when not even that is done in twice the time, NoSurfaceError where there is none, and InvalidInputError
    (FIELD_NOT_FINITE).
    """
    own = _own_triangles(field)
    if own is not None:
        fine = at_most(own, FINE_TRIANGLES, FINE_VERTICES)
        is_small = len(fine.faces) <= COARSE_TRIANGLES and len(fine.vertices) <= COARSE_VERTICES
        return DisplayMeshes(fine, None if is_small else at_most(own, COARSE_TRIANGLES, COARSE_VERTICES))
    return _extracted(field, budget_s)


def _own_triangles(field: SdfField) -> Triangles | None:
    """Those of a field that is a mesh, in its own frame or moved; None of another field."""
    from regnf_core.fields.mesh import MeshField  # loads libigl and trimesh: nearly two seconds

    mesh = field.field if isinstance(field, TransformedField) else field
    if not isinstance(mesh, MeshField):
        return None
    vertices = mesh.vertices
    if isinstance(field, TransformedField):
        vertices = field.T_field_frame.apply_inverse(torch.from_numpy(vertices)).numpy()
    colors = None if mesh.colors is None else mesh.colors.astype(np.float64)
    return used_alone(Triangles(vertices, mesh.faces, colors=colors))


def _extracted(field: SdfField, budget_s: float) -> DisplayMeshes:
    if budget_s <= 0.0:
        raise TooSlowError("the field is too slow to draw")
    began = time.process_time()
    clock = _Clock(began + 2.0 * budget_s)  # an estimate may be wrong: what is nearly done is not thrown away
    coarse = _surface(field, _COARSE_CELLS, clock)
    took = time.process_time() - began
    # the number of cells at the surface, and with it time and triangles, grows with the square of the resolution
    share = min((budget_s - took) / max(took, 1e-3), FINE_TRIANGLES / len(coarse.faces))
    cells = min(int(_COARSE_CELLS * max(share, 0.0) ** 0.5), _MOST_CELLS)
    fine = coarse
    if cells > 1.2 * _COARSE_CELLS:
        try:
            fine = at_most(_surface(field, cells, clock), FINE_TRIANGLES, FINE_VERTICES)
        except TooSlowError:
            fine = coarse
    smaller = at_most(coarse, COARSE_TRIANGLES, COARSE_VERTICES)
    return DisplayMeshes(fine, None if smaller is fine else smaller)


@dataclass(frozen=True)
class _Clock:
    """Ends what takes until after ``end``, by this process's own processor time."""

    end: float

    def __call__(self, evaluations: int) -> None:
        del evaluations
        if time.process_time() > self.end:
            raise TooSlowError("the field is too slow to draw")


def _surface(field: SdfField, cells: int, clock: _Clock) -> Triangles:
    found, colors = extract_surface(field, cells, clock), None
    if has_color(field):  # seen from before the surface
        points, towards = torch.from_numpy(found.vertices), torch.from_numpy(-found.normals)
        parts = zip(torch.split(points, _AT_ONCE), torch.split(towards, _AT_ONCE), strict=True)
        seen = torch.cat([field.color(some, along).cpu() for some, along in parts])
        colors = seen.clamp(0.0, 1.0).double().numpy()
    return Triangles(found.vertices, found.faces, found.normals, colors)


_BUDGET_S = 5.0
"""Processor seconds of the mesh, and of the picture."""


def field_views(path: Path) -> FieldViews:
    """Draw the regnf field file in the file ``path``. What cannot be drawn in good time is left out.

    Raises FieldFormatError for a file that is no regnf field file.
    """
    field, up_axis = open_field(path), read_description(path)["up_axis"]
    fine = coarse = None
    with suppress(RegnfError, MemoryError):
        found = display_meshes(field, _BUDGET_S)
        fine, coarse = (
            None if mesh is None else mesh_file(mesh.vertices, mesh.faces, mesh.normals, mesh.colors)
            for mesh in (found.fine, found.coarse)
        )
    file = io.BytesIO()
    with suppress(RegnfError, MemoryError):
        field_picture(field, up_axis, progress=_Clock(time.process_time() + _BUDGET_S)).save(file, "PNG")
    return FieldViews(fine, coarse, file.getvalue() or None)

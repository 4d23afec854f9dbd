"""The surface of a field as people see it: a mesh with a bounded number of triangles, in two levels of detail."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from regnf_core.errors import RegnfError
from regnf_core.fields.base import SdfField
from regnf_core.fields.color import has_color
from regnf_core.fields.transformed import TransformedField
from regnf_core.surface.isosurface import extract_surface
from regnf_core.viewing.vertex_clustering import Floats, Triangles, at_most, used_alone

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

    reason = "FIELD_PREVIEW_NOT_FOUND"


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
        vertices = field.T_field_frame.inverse().apply(torch.from_numpy(vertices)).numpy()
    colors = None if mesh.colors is None else mesh.colors.astype(np.float64)
    return used_alone(Triangles(vertices, mesh.faces, colors=colors))


def _extracted(field: SdfField, budget_s: float) -> DisplayMeshes:
    if budget_s <= 0.0:
        raise TooSlowError("the field is too slow to be drawn")
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
            raise TooSlowError("the field is too slow to be drawn")


def _surface(field: SdfField, cells: int, clock: _Clock) -> Triangles:
    found = extract_surface(field, cells, clock)
    return Triangles(found.vertices, found.faces, found.normals, _colors(field, found.vertices, found.normals))


def _colors(field: SdfField, vertices: Floats, normals: Floats) -> Floats | None:
    """(V, 3) in [0, 1], seen from before the surface."""
    if not has_color(field):
        return None
    points, towards = torch.from_numpy(vertices), torch.from_numpy(-normals)
    parts = zip(torch.split(points, _AT_ONCE), torch.split(towards, _AT_ONCE), strict=True)
    found = torch.cat([field.color(some, along).cpu() for some, along in parts])
    colors: Floats = found.clamp(0.0, 1.0).double().numpy()
    return colors

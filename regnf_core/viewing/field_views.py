"""Drawing a stored field: its surface as a mesh in two levels of detail, and a picture."""

from __future__ import annotations

import io
import json
import struct
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from regnf_core.errors import RegnfError
from regnf_core.field_notes import FieldViews
from regnf_core.fields.build import open_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import SdfField, has_color
from regnf_core.schema.safe_format import read_description
from regnf_core.schema.similarity import local_origin
from regnf_core.surface.isosurface import extract_surface
from regnf_core.viewing.field_picture import field_picture

# The meshes that people look at as GLB files of one fixed form.
#
# A file has one node (with a translation, where it lies far from the origin), one primitive of triangles, positions,
# perhaps normals (without them it is flat), perhaps colors (as displays show them, like all meshes that regnf
# writes), indices of 32 bits.

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_VERTICES, _INDICES = 34962, 34963
_HEAD = struct.Struct("<5I")


@dataclass(frozen=True)
class _Form:
    """All that a file's JSON depends on."""

    vertices: int
    triangles: int
    normals: bool
    colors: bool
    low: tuple[float, ...]
    high: tuple[float, ...]
    origin: tuple[float, float, float] | None

    @property
    def sections(self) -> list[tuple[str, int]]:
        """What lies in the binary part, one after the other, and how many bytes each has."""
        found = [("POSITION", 12 * self.vertices)]
        if self.normals:
            found.append(("NORMAL", 12 * self.vertices))
        if self.colors:
            found.append(("COLOR_0", 4 * self.vertices))
        return [*found, ("indices", 12 * self.triangles)]

    def text(self) -> bytes:
        """The JSON part, filled up with spaces to a multiple of four bytes."""
        accessors, views, at = [], [], 0
        for number, (name, size) in enumerate(self.sections):
            target = _INDICES if name == "indices" else _VERTICES
            views.append({"buffer": 0, "byteOffset": at, "byteLength": size, "target": target})
            accessors.append({"bufferView": number} | self._accessor(name))
            at += size
        attributes = {name: number for number, (name, _) in enumerate(self.sections[:-1])}
        primitive = {"attributes": attributes, "indices": len(attributes), "mode": 4}
        document = {
            "asset": {"version": "2.0", "generator": "regnf"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0} if self.origin is None else {"mesh": 0, "translation": list(self.origin)}],
            "meshes": [{"primitives": [primitive]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": at}],
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        return text + b" " * (-len(text) % 4)

    def _accessor(self, name: str) -> dict[str, Any]:
        match name:
            case "POSITION":
                ends = {"min": list(self.low), "max": list(self.high)}
                return {"componentType": _FLOAT, "count": self.vertices, "type": "VEC3"} | ends
            case "NORMAL":
                return {"componentType": _FLOAT, "count": self.vertices, "type": "VEC3"}
            case "COLOR_0":
                return {"componentType": _BYTE, "normalized": True, "count": self.vertices, "type": "VEC4"}
        return {"componentType": _INDEX, "count": 3 * self.triangles, "type": "SCALAR"}


def mesh_file(
    vertices: NDArray[Any],
    faces: NDArray[Any],
    normals: NDArray[Any] | None = None,
    colors: NDArray[Any] | None = None,
) -> bytes:
    """The GLB of a mesh. vertices, normals: (V, 3) · faces: (F, 3) · colors: (V, 3) in [0, 1].

    Positions have single precision. So of vertices far from the origin the node's translation has the larger part.
    """
    origin = local_origin([vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()])
    points = np.ascontiguousarray(vertices if origin is None else vertices - np.array(origin), "<f4")
    low, high = (tuple(float(end) for end in ends) for ends in (points.min(axis=0), points.max(axis=0)))
    form = _Form(len(points), len(faces), normals is not None, colors is not None, low, high, origin)
    parts = [points.tobytes()]
    if normals is not None:
        parts.append(np.ascontiguousarray(normals, "<f4").tobytes())
    if colors is not None:
        levels = np.full((len(points), 4), 255, np.uint8)
        levels[:, :3] = np.rint(np.clip(colors, 0.0, 1.0) * 255.0)
        parts.append(levels.tobytes())
    parts.append(np.ascontiguousarray(faces, "<u4").tobytes())
    text, data = form.text(), b"".join(parts)
    whole = _HEAD.size + len(text) + 8 + len(data)
    head = _HEAD.pack(_MAGIC, 2, whole, len(text), _JSON) + text + struct.pack("<2I", len(data), _BINARY)
    return head + data


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
    flat = (cells[:, 0] * _MOST_CLUSTERS + cells[:, 1]) * _MOST_CLUSTERS + cells[:, 2]
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
    return float(max((area / triangles) ** 0.5, longest / (_MOST_CLUSTERS - 1), np.finfo(np.float64).tiny))


def _means(values: Floats, cluster: Ints, counts: Ints) -> Floats:
    """(C, 3) means of values (V, 3) over the clusters."""
    sums = [np.bincount(cluster, values[:, axis], len(counts)) for axis in range(3)]
    means: Floats = np.stack(sums, axis=1) / counts[:, None]
    return means


def _unit(vectors: Floats) -> Floats:
    found: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return found


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


_BUDGET_S = 5.0
"""Processor seconds of the mesh, and of the picture."""


def field_views(path: Path) -> FieldViews:
    """Draw the safe field in the file ``path``. What cannot be drawn in good time is left out.

    Raises FieldFormatError for a file that is no safe field.
    """
    field, up_axis = open_field(path), read_description(path)["up_axis"]
    fine = coarse = None
    with suppress(RegnfError, MemoryError):
        found = display_meshes(field, _BUDGET_S)
        fine, coarse = _file_of(found.fine), None if found.coarse is None else _file_of(found.coarse)
    return FieldViews(fine, coarse, _picture(field, up_axis))


def _file_of(mesh: Triangles) -> bytes:
    return mesh_file(mesh.vertices, mesh.faces, mesh.normals, mesh.colors)


def _picture(field: SdfField, up_axis: str | None) -> bytes | None:
    end = time.process_time() + _BUDGET_S

    def watch(_: int) -> None:
        if time.process_time() > end:
            raise TooSlowError("the field is too slow to be drawn")

    file = io.BytesIO()
    try:
        field_picture(field, up_axis, progress=watch).save(file, "PNG")
    except (RegnfError, MemoryError):
        return None
    return file.getvalue()

"""A point cloud with normals as a field: the distance to its screened Poisson surface (Kazhdan and Hoppe 2013)."""

from __future__ import annotations

import math
import mimetypes
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from regnf_core.errors import FieldFormatError
from regnf_core.importing.cost.cloud_work import FINEST, SPAN, affordable_depth
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.triangles import mesh_field
from regnf_core.importing.meshes.geometry import Float64Array, Geometry, Int64Array, malformed
from regnf_core.importing.upload_description import UploadDescription

_MIN_POINTS = 100
_MAX_POINTS = 300_000
"""Points beyond this are thinned: they cost time and the surface, 256 cells wide, hardly shows them."""
_REACH_SPACINGS, _REACH_SHARE = 4.0, 0.01
"""The surface ends where no point is within this many times their usual spacing, or this share of their diagonal."""
_MEASURED = 10_000
"""Points whose distance to the surface is measured: one that is far from it, and as far from all, takes long."""


def convert_cloud(
    geometry: Geometry, origin: str, overrides: UploadDescription, work_s: float = math.inf
) -> ConvertedField:
    """The field of points with normals that point to free space.

    Raises FieldFormatError: MESH_INVALID, POINT_CLOUD_WITHOUT_NORMALS, IMPORT_TOO_COSTLY beyond ``work_s`` estimated
    seconds, and what ``overrides`` is refused for.
    """
    if geometry.normals is None:
        message = f"{origin} with points and no faces needs normals (nx, ny, nz) that point to free space"
        raise FieldFormatError(message, reason="POINT_CLOUD_WITHOUT_NORMALS")
    points, normals = _usable(geometry.vertices, geometry.normals)
    low, diagonal = points.min(axis=0), float(np.linalg.norm(np.ptp(points, axis=0)))
    if not diagonal > 0.0:
        raise malformed("all points of the cloud are one")
    unit = (points - low) / diagonal
    places = np.unique(unit, axis=0)  # a tree cannot part points at one place: each would be compared with each
    tree = cKDTree(places)
    depth = affordable_depth(unit, work_s)
    vertices, faces = _poisson(unit, normals, depth)
    reach = max(_REACH_SPACINGS * float(np.median(tree.query(places, k=2)[0][:, 1])), _REACH_SHARE)
    near = tree.query(vertices, distance_upper_bound=reach)[0] < reach
    faces = faces[near[faces].all(axis=1)]
    if len(faces) == 0:
        raise malformed("no surface passes near the points: are the normals theirs?")
    surface = Geometry(vertices * diagonal + low, faces, left_out=geometry.left_out)
    width = f"{1 << depth} cells wide"
    found = mesh_field(surface, f"their screened Poisson surface, {width}", overrides, "point_cloud", work_s)
    beside = 100.0 * np.quantile(cKDTree(vertices[near]).query(_some(unit))[0], 0.95)
    why = (f"{origin}: {len(geometry.vertices)} points with normals", *found.why)
    text = f"what lies between the points is a guess; 19 of 20 points are within {beside:.2g} % of the diagonal of it"
    if depth < FINEST:
        text += f"; it is {width} instead of {1 << FINEST}, because its points fill too many cells"
    return replace(found, why=why, warnings=(*found.warnings, f"SURFACE_RECONSTRUCTED: {text}"))


def _usable(points: Float64Array, normals: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Finite points with unit normals, at most so many. Raises FieldFormatError (MESH_INVALID)."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(normals, axis=1)
        sound = (
            np.isfinite(points).all(axis=1) & (np.abs(points) < 1e30).all(axis=1) & np.isfinite(length) & (length > 0)
        )
    points, normals = points[sound], normals[sound] / length[sound, None]
    if len(points) < _MIN_POINTS:
        raise malformed(f"{len(points)} usable points, at least {_MIN_POINTS} are needed")
    if len(points) > _MAX_POINTS:
        chosen = np.random.default_rng(0).permutation(len(points))[:_MAX_POINTS]
        points, normals = points[chosen], normals[chosen]
    return points, normals


def _some(points: Float64Array) -> Float64Array:
    """At most so many of them, drawn at random."""
    if len(points) <= _MEASURED:
        return points
    return points[np.random.default_rng(0).choice(len(points), _MEASURED, replace=False)]


def _poisson(points: Float64Array, normals: Float64Array, depth: int) -> tuple[Float64Array, Int64Array]:
    """The closed surface (V, 3), (F, 3) through the points, faces outward."""
    mimetypes.knownfiles.clear()  # what open3d brings along would read them, which the gate's process may not
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, scale=SPAN, n_threads=1
        )
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)

"""Clouds of points as fields: the distance to their screened Poisson surface (Kazhdan and Hoppe 2013)."""

from __future__ import annotations

import math
import mimetypes
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import NORMALS
from regnf_core.importing.cost.mesh_work import FINEST, SPAN, affordable_depth
from regnf_core.importing.families.cloud_rays import observed_by_rays
from regnf_core.importing.families.converted import ConvertedField, observed_field
from regnf_core.importing.families.triangles import mesh_field, require_extent
from regnf_core.importing.meshes.cloud_normals import Oriented, fit_their_points, oriented
from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, Int64Array, malformed
from regnf_core.importing.upload_description import UploadDescription

MIN_POINTS = 100
_MAX_POINTS = 300_000
"""Points beyond this are thinned: they cost time and the surface, 256 cells wide, hardly shows them."""
_WITH_NORMALS = 0.5
"""Share of the points with a usable normal, below which all are estimated."""
_REACH_SPACINGS, _REACH_SHARE = 4.0, 0.01
"""The surface ends where no point is within this many times their usual spacing, or this share of their diagonal."""
_MEASURED = 10_000
"""Points whose distance to the surface is measured: one that is far from it, and as far from all, takes long."""
_LINE = 1e-4
"""Points that are nearer than this share of their extent to one line have no surface."""
_THINNED = (4_000, 16_000, _MAX_POINTS)
"""Normals are compared among so many points: a patch's border is long among few, a thin board's sides apart in many."""
_ASKED, _NEIGHBORS = 4_000, 24
_PARALLEL, _ACROSS = 0.7, 0.5
"""Cosines between normals: beyond the first they are of one surface or its two sides, below the second of an edge."""
_APART = 0.7
"""Neighbors that face the other way lie beside the others where the middles of both are so many radii apart."""
_BORDERS, _WRONG_EDGES, _BOTH_WAYS = 0.01, 0.2, 0.5
"""Shares of the points, of those at edges and of the points. Chosen on the same clouds as measured on: 22 shapes,
1,000 and 30,000 points, noise of 0, 0.3 and 1 spacings. At edges whole clouds reached 0.17. Turned in vain were 1,000
points of a sheet of 0.5 mm and of 200 blades; patches on thin objects with few points are often missed."""
_FEWEST, _ALL, _FEWEST_EDGES = 3, 0.9, 50
"""A point at an edge has so many neighbors across it; so many of them agree; so many such points are enough."""
_NO_THICKNESS = 0.01
"""Two sides that are nearer than this, in radii of a neighborhood, are one surface whose normals disagree."""


def convert_cloud(
    geometry: Geometry, origin: str, overrides: UploadDescription, work_s: float = math.inf
) -> ConvertedField:
    """The field of points. Normals that are missing, or contradict each other, are made from the points.

    Raises FieldFormatError: MESH_INVALID, POINT_CLOUD_TOO_SMALL, IMPORT_TOO_COSTLY beyond ``work_s`` estimated seconds,
    and what ``overrides`` is refused for.
    """
    if overrides.sensor is not None:
        geometry, overrides = replace(geometry, sensor=np.array(overrides.sensor)), replace(overrides, sensor=None)
    given, dropped = _usable(geometry)
    points = given.vertices
    _require_surface(np.unique(points, axis=0), len(points))
    low, diagonal = points.min(axis=0), float(np.linalg.norm(np.ptp(points, axis=0)))
    require_extent(diagonal)
    unit = (points - low) / diagonal
    places = np.unique(unit, axis=0)  # a tree cannot part points at one place: each would be compared with each
    sensors = given.sensor
    known = sensors is not None and bool(np.isfinite(sensors).all())
    sensor = (sensors - low) / diagonal if sensors is not None and known else None
    made, warnings = oriented_cloud(unit, given.normals, sensor, overrides)
    if made.within is not False and overrides.as_ is None:  # where a sensor looked is free space, within or around
        overrides = replace(overrides, as_="scene")
    tree = cKDTree(places)
    depth = affordable_depth(unit, work_s)
    vertices, faces = _poisson(unit, made.normals, depth)
    spacing = float(np.median(tree.query(places, k=2)[0][:, 1]))
    reach = max(_REACH_SPACINGS * spacing, _REACH_SHARE)
    near = tree.query(vertices, distance_upper_bound=reach)[0] < reach
    faces = faces[near[faces].all(axis=1)]
    if len(faces) == 0:
        raise malformed("no surface passes near the points. Check that the normals belong to the points.")
    surface = Geometry(vertices * diagonal + low, faces, left_out=(*geometry.left_out, *dropped))
    width = f"{1 << depth} cells wide"
    found = mesh_field(surface, f"their screened Poisson surface, {width}", overrides, "point_cloud", work_s)
    beside = 100.0 * np.quantile(cKDTree(vertices[near]).query(_some(unit))[0], 0.95)
    normals = "with" if given.normals is not None else "without"
    why = (f"{origin}: {len(geometry.vertices)} points {normals} normals", *found.why)
    text = (
        f"the surface between the points is interpolated; 95 % of the points are within {beside:.2g} % of the "
        f"diagonal of it"
    )
    if depth < FINEST:
        text += f"; it is {width} instead of {1 << FINEST}, because its points fill too many cells"
    assumes = geometry.assumes if warnings else (*geometry.assumes, NORMALS)  # warnings tell the side of other normals
    warnings = (*found.warnings, *warnings, f"SURFACE_RECONSTRUCTED: {text}")
    found = replace(found, why=why, warnings=warnings, assumes=assumes)
    return found if sensors is None else _observed(found, points, sensors, spacing * diagonal)


def _observed(found: ConvertedField, points: Float64Array, sensors: Float64Array, spacing: float) -> ConvertedField:
    """The field with what was seen from the positions of the sensor. points, sensors: (N, 3), the file's frame."""
    placement = found.description.get("placement")
    origin = np.zeros(3) if placement is None else np.array(placement["transform"])[:3, 3]
    origin = origin / found.description["world_scale"]
    seen = observed_by_rays(points - origin, sensors - origin, spacing)
    if seen is None:
        return replace(found, why=(*found.why, "no observation: the points are not visible from the sensor's position"))
    stood = len(np.unique(sensors[np.isfinite(sensors).all(axis=1)], axis=0))
    return observed_field(found, *seen, f"by the rays from {stood} positions of the sensor")


def oriented_cloud(
    points: Float64Array, normals: Float64Array | None, sensor: Float64Array | None, overrides: UploadDescription
) -> tuple[Oriented, tuple[str, ...]]:
    """Normals that look to free space, and what was done. points: (N, 3), with a diagonal of one."""
    within = None if overrides.as_ is None else overrides.as_ == "scene"
    if normals is not None and not fit_their_points(points, normals):
        made = oriented(points, None, sensor, within)
        lost = "the normals of the file do not fit its points and were replaced"
        return made, (f"NORMALS_ESTIMATED: {lost}; they point to {made.towards}",)
    if normals is None:
        made = oriented(points, None, sensor, within)
        text = f"the points have no normals; normals were estimated, and point to {made.towards}"
        return made, (f"NORMALS_ESTIMATED: {text}",)
    if not overrides.accept_implausible and (found := _turned(points, normals)):
        made = oriented(points, normals, sensor, within)
        return made, (f"NORMALS_TURNED: normals contradicted each other ({found}); they now point to {made.towards}",)
    return Oriented(normals, False, ""), ()


def _usable(geometry: Geometry) -> tuple[Geometry, tuple[str, ...]]:
    """Finite points, at most so many, with normals of length one or none, and what was dropped.

    Raises FieldFormatError (POINT_CLOUD_TOO_SMALL).
    """
    points, normals = geometry.vertices, geometry.normals
    placed = np.isfinite(points).all(axis=1) & (np.abs(points) < 1e30).all(axis=1)
    lost = [(~placed, "points with NaN or infinity")]
    if normals is not None:
        with np.errstate(all="ignore"):
            length = np.linalg.norm(normals, axis=1)
            normals = normals / length[:, None]
        turned = np.isfinite(length) & (length > 0)
        if (placed & turned).sum() < placed.sum() * _WITH_NORMALS:
            normals = None
        else:
            lost.append((placed & ~turned, "points whose normals are zero, NaN or infinity"))
            placed &= turned
    dropped = tuple(f"{int(mask.sum())} {what}" for mask, what in lost if mask.any())
    if placed.sum() < MIN_POINTS:
        message = f"{int(placed.sum())} of {len(points)} points are usable, at least {MIN_POINTS} are needed"
        if dropped:
            message += f"; left out: {', '.join(dropped)}"
        raise FieldFormatError(message, reason="POINT_CLOUD_TOO_SMALL")
    sound = np.flatnonzero(placed)
    if len(sound) > _MAX_POINTS:
        sound = sound[np.random.default_rng(0).permutation(len(sound))[:_MAX_POINTS]]
    sensor = None if geometry.sensor is None else np.broadcast_to(geometry.sensor, points.shape)[sound]
    return replace(
        geometry, vertices=points[sound], normals=None if normals is None else normals[sound], sensor=sensor
    ), dropped


def _require_surface(places: Float64Array, points: int) -> None:
    """Raise FieldFormatError (POINT_CLOUD_TOO_SMALL) for few places (N, 3), however many points, or those of a line."""
    if len(places) < MIN_POINTS:
        message = f"the {points} points have only {len(places)} different positions, at least {MIN_POINTS} are needed"
        raise FieldFormatError(message, reason="POINT_CLOUD_TOO_SMALL")
    wide = np.linalg.svd(places - places.mean(axis=0), compute_uv=False, full_matrices=False)
    if wide[1] < _LINE * wide[0]:
        raise FieldFormatError("the points are on one line", reason="POINT_CLOUD_TOO_SMALL")


def _turned(points: Float64Array, normals: Float64Array) -> str:
    """What shows that normals are turned; "" where nothing does."""
    for most in _THINNED:
        if len(points) <= most:
            return _disagreement(points, normals)
        chosen = np.random.default_rng(0).choice(len(points), most, replace=False)
        if found := _disagreement(points[chosen], normals[chosen]):
            return found
    return ""


def _disagreement(points: Float64Array, normals: Float64Array) -> str:
    """What shows that normals are turned among these points; "" where nothing does."""
    points, first = np.unique(points, axis=0, return_index=True)
    normals = normals[first]
    asked = np.random.default_rng(0).choice(len(points), min(_ASKED, len(points)), replace=False)
    near, number = cKDTree(points).query(points[asked], k=_NEIGHBORS + 1)
    near, number = near[:, 1:], number[:, 1:]  # (Q, K)
    mine, other = normals[asked][:, None], normals[number]
    step = points[number] - points[asked][:, None]  # (Q, K, 3)
    cosine = (mine * other).sum(axis=2)
    height, back = (step * mine).sum(axis=2), -(step * other).sum(axis=2)
    same, opposite = cosine > _PARALLEL, cosine < -_PARALLEL
    mixed = np.minimum(same.sum(axis=1), opposite.sum(axis=1)) >= _NEIGHBORS / 6
    if mixed.any():
        radius = near[mixed, -1]
        flat = step[mixed] - height[mixed][..., None] * mine[mixed]
        aside = np.linalg.norm(_mean(flat, same[mixed]) - _mean(flat, opposite[mixed]), axis=1) / radius
        # Where a patch ends, the others lie to one side; those of a board's other side lie behind, all around.
        borders = float((aside > _APART).sum() / len(asked))
        if borders >= _BORDERS and (aside > _APART).mean() >= 0.5:
            return f"{100.0 * borders:.0f} % of the points are at the border of two patches"
        deep = (
            _mean(height[mixed][..., None], opposite[mixed])[:, 0] - _mean(height[mixed][..., None], same[mixed])[:, 0]
        )
        if mixed.mean() >= _BOTH_WAYS and abs(np.median(deep / radius)) < _NO_THICKNESS:
            return f"those of {100.0 * mixed.mean():.0f} % of the points are mixed at one place"
    # Across an edge both normals see the other point behind them (convex), or both before them (concave).
    least = max(0.3, 3.0 * float(np.median(np.abs(height / near)[same | opposite]))) if (same | opposite).any() else 0.3
    edge = (np.abs(cosine) < _ACROSS) & (np.abs(height) > least * near) & (np.abs(back) > least * near)
    beside = edge.sum(axis=1)
    told = beside >= _FEWEST
    # Where surfaces cross, or a thin board ends, some neighbors say so and some not; at a turned side all do.
    wrong = (edge & (height * back < 0.0)).sum(axis=1)[told] >= _ALL * beside[told]
    if told.sum() < _FEWEST_EDGES or wrong.mean() < _WRONG_EDGES:
        return ""
    return f"at {100.0 * wrong.mean():.0f} % of the edges one of the two faces points inward"


def _mean(values: Float64Array, chosen: npt.NDArray[np.bool_]) -> Float64Array:
    """(Q, D) of the chosen (Q, K) of values (Q, K, D)."""
    mean: Float64Array = (values * chosen[..., None]).sum(axis=1) / chosen.sum(axis=1)[:, None]
    return mean


def _some(points: Float64Array) -> Float64Array:
    """At most so many of them, drawn at random."""
    if len(points) <= _MEASURED:
        return points
    return points[np.random.default_rng(0).choice(len(points), _MEASURED, replace=False)]


def _poisson(points: Float64Array, normals: Float64Array, depth: int) -> tuple[Float64Array, Int64Array]:
    """The closed surface (V, 3), (F, 3) through the points, faces outward."""
    mimetypes.knownfiles.clear()  # what open3d brings along would read them, which the importer's process may not
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, scale=SPAN, n_threads=1
        )
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)

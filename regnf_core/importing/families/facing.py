"""On which side of a mesh's faces space is free: outside an object, inside a room that was scanned from within.

Across a face the generalized winding number (Jacobson et al. 2013) rises by one from front to back, whatever else of
the surface is missing. So its values just before the faces tell what free space has: 0 around a closed object, -1 in a
closed room whose faces look inward, in between where parts are missing. Halfway to the values just behind is the level
that parts free space from matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import igl
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from regnf_core.importing.meshes.triangle_files import Float64Array, Int64Array

# The generalized winding number of a mesh (Jacobson et al. 2013), and places just before its faces to ask it at.

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


SAMPLES = 2_000
"""Places on the faces, and as many in the volume, where the winding number is requested."""
_CLOSED = 0.1
"""Free space this near to 0 counts as that around a closed mesh."""
INWARD = -0.6
"""Below this, most faces look into a hollow: sheets that are open on one side have -0.5."""
_FILLED, _WITHIN = 0.45, 0.05
"""A room's free space takes this share of its box, and this share of its faces lies ..."""
_DEPTH = 0.03
"""... at least so deep beneath its convex hull, in diagonals: they are of what stands in it."""
_BURIED = 0.5
"""Faces before which the winding number is above this lie within another solid."""

Asked = Literal["scene", "object"] | None


@dataclass(frozen=True)
class Facing:
    """``level``: matter is where the winding number exceeds it. free: that of free space near the faces."""

    faces: Int64Array
    level: float
    free: float
    why: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def facing_of(vertices: Float64Array, faces: Int64Array, asked: Asked) -> Facing:
    """Decide by what the faces look at, and by what is ``asked`` for. vertices: (V, 3), faces: (F, 3)."""
    before = _winding_before(vertices, faces)
    if asked == "scene" and (shell := _outer_shell(vertices, faces, before)) is not None:
        faces = np.where(shell[:, None], faces[:, ::-1], faces)
        before = _winding_before(vertices, faces)
        return _seen_from_within(
            faces, before, "its outermost part encloses the rest, and its faces were flipped towards it"
        )
    free = float(np.median(before.values))
    if free > INWARD:
        return _outward(faces, free)
    if asked == "object" or (asked is None and not _is_room(vertices, faces, before, free + 0.5)):
        turned = (
            "its faces pointed inward and were flipped. If it is a room seen from inside, give the import option "
            "as: scene"
        )
        found = _outward(faces[:, ::-1], float(np.median(_winding_before(vertices, faces[:, ::-1]).values)))
        return Facing(found.faces, found.level, found.free, found.why, (f"MESH_INSIDE_OUT: {turned}",))
    told = (
        "the import option is scene"
        if asked == "scene"
        else "they enclose most of the mesh's box, and other parts in it"
    )
    found = _seen_from_within(faces, before, f"its faces point inward, and {told}")
    if asked is None:
        text = (
            "it was imported as a room seen from inside. If it is an object with flipped faces, give the import "
            "option as: object"
        )
        return Facing(found.faces, found.level, found.free, found.why, (f"SCENE_ASSUMED: {text}",))
    return found


@dataclass(frozen=True)
class _Before:
    """Places just before faces, uniform over the area. places: (N, 3), face: (N,), values: the winding number there."""

    places: Float64Array
    face: Int64Array
    values: Float64Array


def _winding_before(vertices: Float64Array, faces: Int64Array) -> _Before:
    area = areas(vertices, faces)
    random = np.random.default_rng(0)
    face = random.choice(len(faces), SAMPLES, p=area / area.sum())
    places = places_before(vertices, faces, face, random)
    return _Before(places, face, winding_number(vertices, faces, places))


def _outward(faces: Int64Array, free: float) -> Facing:
    """Faces that look outward, or to one side: free space is what they look at."""
    if free > -_CLOSED:
        return Facing(faces, 0.5, free, ())
    why = f"parts of the surface are missing: free space in front of it has the winding number {free:.2f}, not 0"
    return Facing(faces, _level(free), free, (why,))


def _seen_from_within(faces: Int64Array, before: _Before, why: str) -> Facing:
    free = float(np.median(before.values))
    missing = 100.0 * min(max(1.0 + free, 0.0), 1.0)
    seen = f"seen from inside: {why}; {missing:.2g} % of what encloses it is missing"
    return Facing(faces, _level(free), free, (seen,))


def _level(free: float) -> float:
    """Halfway between the two sides of a face."""
    return round(min(max(free + 0.5, -0.5), 0.5), 3)


def _is_room(vertices: Float64Array, faces: Int64Array, before: _Before, level: float) -> bool:
    """Whether the free side fills the mesh's box, and things stand in it: an empty box is an object turned round."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    probes = low + (high - low) * np.random.default_rng(1).random((SAMPLES, 3))
    if (winding_number(vertices, faces, probes) < level).mean() < _FILLED:
        return False
    if _holds_solids(vertices, faces):
        return True
    try:
        hull = ConvexHull(before.places)
    except QhullError:  # flat
        return False
    depth = -(before.places @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
    return bool((depth > _DEPTH * np.linalg.norm(high - low)).mean() >= _WITHIN)


def _holds_solids(vertices: Float64Array, faces: Int64Array) -> bool:
    """Whether the part that encloses the others looks inward and most of these look outward: parts of an object that
    was turned round all look inward."""
    part, shell = _parts(vertices, faces)
    corners = vertices[faces] - vertices[faces].mean(axis=(0, 1))
    volume = np.bincount(part, np.linalg.det(corners))
    area = np.bincount(part, areas(vertices, faces))
    others = np.arange(len(volume)) != shell
    return bool(volume[shell] < 0.0 and area[others & (volume > 0.0)].sum() > area[others].sum() / 2.0)


def _parts(vertices: Float64Array, faces: Int64Array) -> tuple[Int64Array, int]:
    """The part (F,) of each face, and the number of the part with the largest box."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), np.int8), edges.T), shape=(len(vertices), len(vertices)))
    parts, part = connected_components(graph, directed=False)
    low, high = np.full((parts, 3), np.inf), np.full((parts, 3), -np.inf)
    np.minimum.at(low, part, vertices)
    np.maximum.at(high, part, vertices)
    extent = np.where(np.isfinite(low), high - low, 0.0)
    return part[faces[:, 0]].astype(np.int64), int(np.argmax(np.prod(extent, axis=1)))


def _outer_shell(vertices: Float64Array, faces: Int64Array, before: _Before) -> npt.NDArray[np.bool_] | None:
    """Which faces (F,) are of the part that encloses others and looks outward; None where none does."""
    buried = before.values > _BURIED
    if buried.mean() < _WITHIN:
        return None
    part, outermost = _parts(vertices, faces)
    shell: npt.NDArray[np.bool_] = part == outermost
    if shell[before.face[buried]].mean() > _WITHIN:
        return None
    return shell

"""Triangles as an exact distance field: welded, without triangles of no area, normals towards free space."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import igl
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from regnf_core.errors import FieldFormatError
from regnf_core.importing.assumptions import FACES
from regnf_core.importing.cost.mesh_work import mesh_seconds, require_within
from regnf_core.importing.families.color.head import with_values
from regnf_core.importing.families.converted import ConvertedField
from regnf_core.importing.families.facing import (
    INWARD,
    SAMPLES,
    Asked,
    Facing,
    areas,
    facing_of,
    places_before,
    winding_number,
)
from regnf_core.importing.families.layers import entries_at, refuse_other_entries, require_family, shared_entries
from regnf_core.importing.meshes.triangle_files import Float64Array, Geometry, Int64Array, malformed
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.schema.similarity import local_origin

# Parts of a mesh whose faces look into them, while those of the rest face free space: they would be no matter.
#
# Free space has the same generalized winding number everywhere, and matter has more. Less than that of free space is
# found within such a part alone: a leg of a chair that was mirrored, a blade that was exported the wrong way round.
# Only parts that are closed, or nearly so, can tell: sheets that were scanned from one side may face each other.

BoolArray = npt.NDArray[np.bool_]
_MOST = 300
"""Parts that are looked at, the largest ones."""
_PLACES = 9
"""On each of them, where the winding number is requested."""
_CLOSED = -0.9
"""A part is closed, or nearly so, and looks into itself, if the median winding number of its own faces, at the places
before them, is below this."""
_FEW = 0.002
"""Share of the area: less is not worth a change."""
_ROUNDS = 2
"""A part within another is told only when the other one is right."""
PLACES = _MOST * _PLACES * (2 * _ROUNDS + 1)
"""At most so many winding numbers are requested."""


def facing_outward(vertices: Float64Array, faces: Int64Array, free: float) -> tuple[Int64Array, tuple[str, ...]]:
    """The faces (F, 3), those of parts that look into themselves turned round, and what was done.

    vertices: (V, 3) · free: the winding number of free space. A part is a patch of faces that agree with each other.
    """
    part = np.asarray(igl.bfs_orient(np.ascontiguousarray(faces))[1]).reshape(-1)
    area = areas(vertices, faces)
    sizes = np.bincount(part, area)
    if len(sizes) == 1:
        return faces, ()
    looked_at = np.argsort(-sizes, kind="stable")[:_MOST]
    drawn = _drawn(part, area, looked_at)

    def with_turned(turned: BoolArray) -> Int64Array:
        return np.where(turned[part][:, None], faces[:, ::-1], faces)

    def inward(turned: BoolArray) -> BoolArray:
        found = np.zeros(len(sizes), bool)
        found[looked_at] = _before(vertices, with_turned(turned), drawn) < free + INWARD
        return found

    turned = _to_turn(inward, len(sizes))
    for number, chosen in zip(looked_at, drawn, strict=True):
        if turned[number]:
            places = places_before(vertices, faces, chosen, np.random.default_rng(1))
            own = winding_number(vertices, faces[part == number], places)
            turned[number] = np.median(own) < _CLOSED
    share = float(sizes[turned].sum() / sizes.sum())
    if share <= _FEW:
        return faces, ()
    told = f"{100.0 * share:.2g} % of its surface was flipped: parts whose faces pointed inward"
    return with_turned(turned), (told,)


def _to_turn(inward: Callable[[BoolArray], BoolArray], count: int) -> BoolArray:
    """Which of so many parts to turn; what looks inward either way stays. inward: of the parts, with these turned."""
    turned, tried = np.zeros(count, bool), np.zeros(count, bool)
    found = inward(turned)
    for _ in range(_ROUNDS):
        wrong = found & ~tried
        if not wrong.any():
            break
        tried |= wrong
        found = inward(turned ^ wrong)
        useless = wrong & found
        turned ^= wrong & ~useless
        if useless.any():
            found = inward(turned)
    return turned


def _drawn(part: Int64Array, area: Float64Array, looked_at: Int64Array) -> Int64Array:
    """(P, K): numbers of faces of each part that is looked at, uniform over its area."""
    order = np.argsort(part, kind="stable")
    reached = np.cumsum(area[order])
    sizes = np.bincount(part, area)
    start = np.cumsum(sizes) - sizes
    aimed = start[looked_at, None] + sizes[looked_at, None] * np.random.default_rng(0).random((len(looked_at), _PLACES))
    found: Int64Array = order[np.searchsorted(reached, aimed).clip(max=len(order) - 1)]
    return found


def _before(vertices: Float64Array, faces: Int64Array, drawn: Int64Array) -> Float64Array:
    """(P,): the median winding number before the drawn faces (P, K) of each part."""
    places = places_before(vertices, faces, drawn.reshape(-1), np.random.default_rng(1))
    median: Float64Array = np.median(winding_number(vertices, faces, places).reshape(drawn.shape), axis=1)
    return median


# Faces that are turned round among their neighbors: exporters and repairs leave such, each a dent in the field.

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
    area = areas(vertices, faces)
    for_it = np.bincount(patch, np.where(kept, area, -area))
    turned = kept == (for_it[patch] < 0.0)
    found = np.where(turned[:, None], faces[:, ::-1], faces)
    if not turned.any() or _disagreeing(found) > _FEWER * before:
        return faces, ()
    share = 100.0 * float(area[turned].sum() / area.sum())
    return found, (f"{share:.2g} % of its surface was flipped to match the neighboring faces",)


def _disagreeing(faces: Int64Array) -> float:
    """Share of the edges that two faces run through in one direction."""
    start, end = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    count = np.unique(start * (int(faces.max()) + 1) + end, return_counts=True)[1]
    return float((count > 1).sum() / len(count))


_MARGIN = 0.05
"""How far the bounds reach beyond the mesh, in its diagonals: free space from which its surface can be seen."""
_LARGEST = 1e30
_SHORTEST = 1e-16
_BLUNT = 1e-6
"""Of the diagonal: steps between single-precision numbers that are longer are said."""
_TOO_BLUNT = 2.0
"""Percent of the diagonal: longer steps leave no shape."""
_DOUBLED = 0.5
"""Share of the faces that are there twice, once turned: beyond this the file is a double-sided mesh."""
_ODD = 0.01
"""Of the faces so many, or one, may have corners that do not exist."""
_CLOSED_BUT_FOR = 0.005
"""Share of the edges that may be open in a mesh that counts as closed."""
_MANY_PARTS = 1000
_STRAY = 4.0
"""Diagonals of the rest: parts beyond so wide a gap are said."""


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles near the origin of their own frame, faces towards free space.

    vertices: (V, 3) float32 · origin: what was subtracted from the file's places in float64, None: nothing · kept: (V,)
    the vertices' numbers in the file · facing: (F, 3) faces and the level of matter · ignored: what was dropped, with
    counts.
    """

    vertices: npt.NDArray[np.float32]
    origin: tuple[float, float, float] | None
    kept: Int64Array
    facing: Facing
    ignored: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def places(self) -> Float64Array:
        """(V, 3) float64, the file's frame."""
        places: Float64Array = self.vertices.astype(np.float64) + np.array(self.origin or (0.0, 0.0, 0.0))
        return places


def mesh_field(
    geometry: Geometry, origin: str, overrides: UploadDescription, family: str = "mesh", work_s: float = math.inf
) -> ConvertedField:
    """The exact distance to triangles. ``origin``: what they come from, for the report. Raises as ``convert_mesh``."""
    require_family(overrides, family)
    refuse_other_entries(overrides, family, ("node",))
    overrides = replace(overrides, up_axis=overrides.up_axis or geometry.up_axis)
    asked = "object" if overrides.sign == -1 else overrides.as_  # who turns the sign round means the turned faces
    solid = solid_of(geometry, asked, work_s)
    faces, places = solid.facing.faces, solid.places
    low, high = places.min(axis=0), places.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    bounds = [(low - _MARGIN * diagonal).tolist(), (high + _MARGIN * diagonal).tolist()]
    loose = _open_edge_share(faces)
    why = (
        f"{origin}: {len(faces)} triangles, {len(places)} vertices",
        "watertight"
        if loose == 0.0
        else f"not watertight, {100 * loose:.2g} % of its edges are open: the winding number decides what is inside",
        *solid.facing.why,
        *(f"ignored: {what}" for what in (*geometry.left_out, *solid.ignored)),
        *geometry.notes,
    )
    converted = ConvertedField(
        family,
        why,
        {
            "kind": "mesh",
            "source": {"family": family},
            "inside_above": solid.facing.level,
            **entries_at(shared_entries(overrides, bounds), solid.origin),
        },
        {"vertices": solid.vertices, "faces": np.ascontiguousarray(faces, dtype=np.int32)},
        solid.warnings,
        assumes=(*(() if loose == 0.0 else (FACES,)), *geometry.assumes),
    )
    colors = None if overrides.color.keep is False else geometry.colors
    return with_values(converted, lambda: None if colors is None else colors[solid.kept].astype(np.float16))


def solid_of(geometry: Geometry, asked: Asked = None, work_s: float = math.inf) -> Solid:
    """The triangles of a file, cleaned: the one way for files that are imported and for those that are fitted.

    asked: what the mesh is, where that is known. Raises FieldFormatError: MESH_INVALID, IMPORT_TOO_COSTLY.
    """
    given, ignored = _sound_faces(geometry)
    corners = geometry.vertices[np.unique(given)]
    box = [corners.min(axis=0).tolist(), corners.max(axis=0).tolist()]
    origin = local_origin(box)
    require_extent(math.dist(*box))
    near = geometry.vertices if origin is None else geometry.vertices - np.array(origin)
    vertices, faces, kept, dropped = _welded(near, given)
    require_within(mesh_seconds(vertices, faces, 3 * SAMPLES + PLACES), work_s)
    facing = _oriented(vertices.astype(np.float64), faces, asked)
    lost = [f"GEOMETRY_IGNORED: not read: {', '.join(geometry.not_applied)}"] if geometry.not_applied else []
    warnings = (*facing.warnings, *lost, *_blunt(corners, box), *_scattered(vertices, facing.faces))
    return Solid(vertices, origin, kept, facing, (*ignored, *dropped), warnings)


def require_extent(diagonal: float) -> None:
    """Raise FieldFormatError (MESH_INVALID) for lengths whose squares single precision cannot hold."""
    if not _SHORTEST <= diagonal <= 1.0 / _SHORTEST:
        message = f"its diagonal is {diagonal:.3g}, expected {_SHORTEST:g} to {1.0 / _SHORTEST:g}"
        raise FieldFormatError(
            message, reason="MESH_INVALID", hint="Give the mesh in another unit, or remove stray points."
        )


def _oriented(vertices: Float64Array, faces: Int64Array, asked: Asked) -> Facing:
    """The faces (F, 3) of welded triangles turned towards free space, as far as their places tell. vertices: (V, 3)."""
    faces, agreed = agreeing(vertices, faces)
    facing = facing_of(vertices, faces, asked)
    faces, parts = facing_outward(vertices, facing.faces, facing.free)
    return replace(facing, faces=faces, why=(*agreed, *facing.why, *parts))


def _sound_faces(geometry: Geometry) -> tuple[Int64Array, tuple[str, ...]]:
    """The faces (F, 3) whose corners are places, and what was left out. Raises FieldFormatError (MESH_INVALID)."""
    faces, ignored = geometry.faces, list[str]()
    known = ((faces >= 0) & (faces < len(geometry.vertices))).all(axis=1)
    if not known.all():
        lost = int((~known).sum())
        if lost > max(_ODD * len(faces), 1) or lost == len(faces):
            raise malformed(f"{lost} of its {len(faces)} faces refer to a vertex that does not exist")
        faces = faces[known]
        ignored.append(f"{lost} triangles with a corner of no vertex")
    with np.errstate(invalid="ignore"):
        sound = np.asarray((np.abs(geometry.vertices) <= _LARGEST).all(axis=1))
    if sound.all():
        return faces, tuple(ignored)
    kept = faces[sound[faces].all(axis=1)]
    if len(kept) == 0:
        raise malformed("no triangle of the mesh has finite corners")
    ignored.append(f"{int((~sound).sum())} vertices with NaN or infinity")
    if len(kept) < len(faces):
        ignored.append(f"{len(faces) - len(kept)} triangles with such a corner")
    return kept, tuple(ignored)


def _welded(
    vertices: Float64Array, faces: Int64Array
) -> tuple[npt.NDArray[np.float32], Int64Array, Int64Array, tuple[str, ...]]:
    """Vertices at one place are one; those of no face, triangles without area and repeated ones are dropped.

    Also the number, in the file, of each vertex that is left, and what was dropped.
    """
    used, faces = np.unique(faces, return_inverse=True)
    places = vertices[used].astype(np.float32) + np.float32(0.0)  # adding zero makes -0.0 plain
    rows = np.ascontiguousarray(places).view([("", np.float32)] * 3).reshape(-1)
    _, first, number = np.unique(rows, return_index=True, return_inverse=True)
    corners = number.reshape(-1)[faces.reshape(-1, 3)]
    a, b, c = (places[first][corners[:, i]].astype(np.float64) for i in range(3))
    flat = ~(np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0)
    ignored = [f"{int(flat.sum())} triangles without an area"] if flat.any() else []
    corners = corners[~flat]
    if len(corners) == 0:
        raise malformed("no triangle of the mesh has an area")
    corners, repeated = _once(corners)
    kept, corners = np.unique(corners, return_inverse=True)
    return places[first][kept], corners.reshape(-1, 3), used[first][kept], (*ignored, *repeated)


def _once(corners: Int64Array) -> tuple[Int64Array, tuple[str, ...]]:
    """The triangles (F, 3) without those that are there again, and of a double-sided mesh one side, the first."""
    turns = (np.argmin(corners, axis=1)[:, None] + np.arange(3)) % 3
    begun = np.take_along_axis(corners, turns, axis=1)  # the least corner first: one row for a triangle, however told
    ignored: list[str] = []
    found = _first_of(begun)
    if len(found) < len(corners):
        ignored.append(f"{len(corners) - len(found)} duplicate triangles")
        corners, begun = corners[found], begun[found]
    sides = _first_of(np.sort(begun, axis=1))
    twice = len(corners) - len(sides)
    # Of fewer one side is dropped only where that closes the mesh. Walls between solids, which are closed, stay.
    if 2 * twice > _DOUBLED * len(corners) or (
        twice and _edges(corners)[1].any() and (_edges(corners[sides])[0] != 2).mean() <= _CLOSED_BUT_FOR
    ):
        ignored.append(f"{twice} triangles of the other side: the mesh is double-sided")
        corners = corners[sides]
    return corners, tuple(ignored)


def _first_of(rows: Int64Array) -> Int64Array:
    """The numbers, ascending, of the first of each kind of row (N, 3)."""
    order = np.lexsort(rows.T)  # stable
    ordered = rows[order]
    new = np.ones(len(rows), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    first: Int64Array = np.sort(order[new])
    return first


def _blunt(corners: Float64Array, box: list[list[float]]) -> tuple[str, ...]:
    """A warning where places far from the origin have the digits of single precision alone. corners: (V, 3)."""
    reach, diagonal = float(np.abs(corners).max()), math.dist(*box)
    step = float(np.spacing(np.float32(reach)))
    if step <= _BLUNT * diagonal or not (corners == corners.astype(np.float32)).all():
        return ()
    share = 100.0 * step / diagonal
    if share > _TOO_BLUNT:
        message = (
            f"its vertices are {reach:.6g} from the origin in single precision, whose steps there are {step:.2g}, "
            f"{share:.2g} % of its diagonal: its shape is lost. Move it to the origin before it is written, or write "
            f"it with double precision"
        )
        raise malformed(message)
    text = (
        f"its vertices are {reach:.6g} from the origin, where single precision has steps of {step:.2g}, {share:.2g} "
        f"% of its"
        " diagonal: finer details are lost. Write it with double precision, or move it to the origin before writing"
    )
    return (f"FAR_FROM_ORIGIN: {text}",)


def _scattered(vertices: npt.NDArray[np.float32], faces: Int64Array) -> tuple[str, ...]:
    """Warnings of very many parts, and of a few faces far from all others."""
    found = []
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(edges), np.int8), edges.T), shape=(len(vertices), len(vertices)))
    parts = int(connected_components(graph, directed=False)[0])
    if parts > _MANY_PARTS:
        text = f"it has {parts} separate parts. Their inside is computed for all together, which takes long"
        found.append(f"MANY_PARTS: {text}")
    corners = vertices.astype(np.float64)[faces]  # (F, 3, 3)
    area = areas(vertices.astype(np.float64), faces)
    for axis in range(3):
        low, high = corners[..., axis].min(axis=1), corners[..., axis].max(axis=1)
        order = np.argsort(low)
        gaps = low[order][1:] - np.maximum.accumulate(high[order])[:-1]
        if not len(gaps) or not gaps.max() > 0.0:
            continue
        at = int(gaps.argmax()) + 1
        stray, rest = sorted((order[:at], order[at:]), key=lambda side: float(area[side].sum()))
        size = float(np.linalg.norm(np.ptp(corners[rest].reshape(-1, 3), axis=0)))
        if gaps.max() > _STRAY * size:
            text = f"{len(stray)} of its triangles lie {gaps.max():.3g} from the rest, which is {size:.3g} across"
            found.append(f"STRAY_PARTS: {text}: remove them if they do not belong to the object")
            break
    return tuple(found)


def _edges(faces: Int64Array) -> tuple[Int64Array, Float64Array]:
    """Of each edge how many faces (F, 3) it has, and how many more run through it one way than the other."""
    start, end = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    key = np.minimum(start, end) * (int(faces.max()) + 1) + np.maximum(start, end)
    _, number, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.asarray(count, np.int64), np.bincount(number, np.where(start < end, 1.0, -1.0)).astype(np.float64)


def _open_edge_share(faces: Int64Array) -> float:
    """Share of the directed edges that no neighbor runs through the other way, exactly once."""
    start, end = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    vertices = int(faces.max()) + 1
    forward, count = np.unique(start * vertices + end, return_counts=True)
    single = forward[count == 1]
    matched = np.isin(single // vertices + (single % vertices) * vertices, single, assume_unique=True)
    return float(1.0 - matched.sum() / len(start))

"""Normals of points that have none, or whose normals contradict each other: lines from the neighbors, sides from what
can have measured the points.

A sensor measures what it sees. So the fewest places are looked for from which all points are seen, each point hiding
what is behind its own small disc, and a point's normal looks to the first of these places that sees it. They lie
around an object and within a scene; where the file says where its sensor stood, that is the place. A hollow shell is
seen from within as well as from outside: of two places, the one from which the points bulge outward is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnf_core.importing.meshes.triangle_files import Float64Array, Int64Array

BoolArray = npt.NDArray[np.bool_]
_NEIGHBORS, _BESIDE = 16, 8
"""Of a point's plane, and of those that its side should agree with."""
_SPACING_OF = 6
"""The distance to this neighbor is that of 1.38 spacings, on a plane."""
_POINTS = 20_000
"""So many points see each other; the others take the sides of these."""
_OUTSIDE, _AWAY = 64, 2.5
"""Places around an object, and how far they are from its middle, diagonals."""
_WITHIN, _GRID, _LEAST_ROOM = 24, 12, 0.03
"""Places within a scene: those of a grid with so many cells along each axis that are farthest from all points and from
each other, at least this share of the diagonal."""
_STEEP = 0.3
"""Cosine: a point is measured by a sensor that it faces at least so much."""
_BULGE = 0.5
"""How much less a point counts for a place from which the shape is hollow there."""
_GAIN = 0.003
"""Share of the points that a further place must add."""
_DISC, _PIXEL, _WIDEST, _SLACK = 1.3, 0.6, 4, 0.6
"""In spacings: the radius of a point's disc, a pixel, and how far behind it a point still belongs to a surface; and how
many pixels a disc may reach."""
_FINEST = 1_200
"""Pixels along an edge of a view."""
_SMOOTH, _ROUNDS = 0.2, 60
"""What a point sees itself counts so much beside its neighbors; rounds in which these are asked."""
_UNSEEN = 0.2
"""Where more of the points are seen from nowhere outside, the cloud is of a scene."""
_LINES = 0.5
"""How far normals agree with the neighbors' planes beyond chance, 0 to 1; with less they are of other points."""


@dataclass(frozen=True, eq=False)
class Oriented:
    """Normals (N, 3) of length one that look to free space. within: whether to places within the cloud, None: to where
    the file's sensor stood · towards: where they look to, in words."""

    normals: Float64Array
    within: bool | None
    towards: str


def fit_their_points(points: Float64Array, normals: Float64Array) -> bool:
    """Whether normals (N, 3) lie across the surface that points (N, 3) are on, whatever their side."""
    few = _few(len(points))
    lines, given = _planes(points, points[few])[0], normals[few]
    agree = float(np.abs((lines * given).sum(axis=1)).mean())
    others = given[np.random.default_rng(1).permutation(len(given))]
    chance = float(np.abs((lines * others).sum(axis=1)).mean())
    return agree - chance >= _LINES * (1.0 - chance)


def oriented(
    points: Float64Array, given: Float64Array | None, sensor: Float64Array | None, within: bool | None
) -> Oriented:
    """The normals of points (N, 3), with a diagonal of one.

    given: (N, 3) normals of unknown side; None: they are estimated · sensor: (3,), where all points were measured from,
    or (N, 3), where each was · within: whether they are of a scene that was measured from within; None: by what can be
    seen.
    """
    lines = _planes(points, points)[0]
    if sensor is not None:
        own = lines if given is None else given
        looks = ((sensor - points) * own).sum(axis=1)
        return Oriented(np.where(looks[:, None] >= 0.0, own, -own), None, "the position of the sensor")
    few = _few(len(points))
    some, along = points[few], lines[few]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    signs = np.ones(len(some))
    if not within:
        signs, unseen = _signs(some, along, middle + _AWAY * directions(_OUTSIDE), middle)
        within = within is None and unseen > _UNSEEN
    if within:
        signs, _ = _signs(some, along, _free_places(some), None)
    sided = along * signs[:, None]
    normals = sided
    if len(few) < len(points):
        _, nearest = cKDTree(some).query(points, k=4)
        agree = np.einsum("nki,ni->n", sided[nearest], lines)
        normals = np.where(agree[:, None] >= 0.0, lines, -lines)
    if given is not None:
        normals = given * np.where((given * normals).sum(axis=1) >= 0.0, 1.0, -1.0)[:, None]
    where = "inside the cloud, as for a scene" if within else "outside of the cloud, as for an object"
    other = "object" if within else "scene"
    towards = (
        f"positions {where}, from which the points are visible; if this is wrong, give the import option as: {other}"
    )
    return Oriented(normals, bool(within), towards)


def _few(count: int) -> Int64Array:
    if count <= _POINTS:
        return np.arange(count)
    return np.random.default_rng(0).permutation(count)[:_POINTS]


def _planes(points: Float64Array, places: Float64Array) -> tuple[Float64Array, Float64Array, Int64Array]:
    """For places (N, 3) among points: the normals (N, 3) of their neighbors' planes, sides by chance, and the distances
    and numbers (N, K + 1) of these neighbors, the place itself the first."""
    apart, near = cKDTree(points).query(places, k=min(_NEIGHBORS + 1, len(points)))
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return axes[:, :, 0], apart, near


def directions(count: int) -> Float64Array:
    """(count, 3): spread evenly over the unit sphere, by the golden angle."""
    number = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + 5.0**0.5) * number
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)


def _free_places(points: Float64Array) -> Float64Array:
    """(V, 3): places within the points' box that are far from all of them and from each other."""
    low, high = points.min(axis=0), points.max(axis=0)
    steps = (np.arange(_GRID) + 0.5) / _GRID
    grid = low + (high - low) * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    room = cKDTree(points).query(grid)[0]
    chosen: list[int] = []
    while len(chosen) < _WITHIN and (not chosen or room.max() > _LEAST_ROOM):
        chosen.append(int(room.argmax()))
        room = np.minimum(room, np.linalg.norm(grid - grid[chosen[-1]], axis=1))
    places: Float64Array = grid[chosen]
    return places


def _signs(
    points: Float64Array, lines: Float64Array, places: Float64Array, middle: Float64Array | None
) -> tuple[Float64Array, float]:
    """(N,) 1 or -1 for the lines (N, 3), and the share of points that none of the places (V, 3) sees.

    middle: (3,) of an object, from which its surface bulges; None: it does not count.
    """
    _, apart, near = _planes(points, points)
    size = apart[:, min(_SPACING_OF, apart.shape[1] - 1)] / 1.38
    facing = np.stack([_cosines(place - points, lines) for place in places])
    seen = np.stack([_visible(points, lines, size, place) for place in places]) & (np.abs(facing) > _STEEP)
    counts = np.ones(facing.shape)
    if middle is not None:
        counts += _BULGE * np.sign(facing * ((points - middle) * lines).sum(axis=1))
    first, left = np.full(len(points), -1), np.ones(len(points), dtype=bool)
    while left.any():
        best = int(((seen & left) * counts).sum(axis=1).argmax())
        found = seen[best] & left
        if found.sum() < _GAIN * len(points):
            break
        first[found] = best
        left &= ~found
    own = np.where(left, 0.0, facing[first, np.arange(len(points))])
    return _agreed(points, lines, own, near[:, 1 : _BESIDE + 1]), float(left.mean())


def _cosines(towards: Float64Array, lines: Float64Array) -> Float64Array:
    found: Float64Array = (towards * lines).sum(axis=1) / np.linalg.norm(towards, axis=1).clip(1e-12)
    return found


def _agreed(points: Float64Array, lines: Float64Array, own: Float64Array, near: Int64Array) -> Float64Array:
    """(N,) 1 or -1: the sides ``own`` (N,), -1 to 1, smoothed along the surface. near: (N, K) neighbors."""
    step = points[near] - points[:, None]
    length = np.linalg.norm(step, axis=2).clip(1e-12)
    cosine = np.einsum("nki,ni->nk", lines[near], lines)
    heights = np.abs(np.einsum("nki,ni->nk", step, lines)), np.abs(np.einsum("nki,nki->nk", step, lines[near]))
    off = np.maximum(*heights) / length / 0.3
    weight = cosine * np.abs(cosine) ** 3 * np.exp(-(off**2))
    side = own
    for _ in range(_ROUNDS):
        side = np.tanh(2.0 * (_SMOOTH * own + 2.0 * (weight * side[near]).mean(axis=1)))
    return np.where(side >= 0.0, 1.0, -1.0)


def _visible(points: Float64Array, lines: Float64Array, size: Float64Array, eye: Float64Array) -> BoolArray:
    """(N,): which points are seen from a place (3,), each hiding what is behind its disc. size: (N,) their spacings.

    Points are drawn on the six faces of a cube around the place, by their depths along its axes.
    """
    away = points - eye
    axis = np.abs(away).argmax(axis=1)
    face = 2 * axis + (np.take_along_axis(away, axis[:, None], 1)[:, 0] > 0)
    seen = np.ones(len(points), dtype=bool)
    for one in np.unique(face):
        chosen = np.flatnonzero(face == one)
        order = [one // 2, (one // 2 + 1) % 3, (one // 2 + 2) % 3]
        flip = np.array([1.0 if one % 2 else -1.0, 1.0, 1.0])
        seen[chosen] = _seen_on_face(away[chosen][:, order] * flip, lines[chosen][:, order] * flip, size[chosen])
    return seen


def _seen_on_face(away: Float64Array, lines: Float64Array, size: Float64Array) -> BoolArray:
    """(N,): the points (N, 3) that are seen from the origin, which looks along the first axis."""
    depth = away[:, 0].clip(1e-9)
    image = away[:, 1:] / depth[:, None]
    low, extent = image.min(axis=0), float(np.ptp(image, axis=0).max())
    pixel = max(_PIXEL * float(np.median(size / depth)), extent / _FINEST, 1e-9)
    radius = _DISC * size
    reach = int(np.clip(np.ceil(np.quantile(radius / depth, 0.9) / pixel), 1, _WIDEST))
    at = ((image - low) / pixel).astype(int) + reach
    width = int(at[:, 1].max()) + reach + 1
    plane = (away * lines).sum(axis=1)
    drawn: list[tuple[Int64Array, Float64Array]] = []
    steps = range(-reach, reach + 1)
    for down, aside in ((down, aside) for down in steps for aside in steps):
        pixels = at + np.array([down, aside])
        ray = np.column_stack([np.ones(len(at)), (pixels - reach + 0.5) * pixel + low])
        with np.errstate(all="ignore"):
            there = plane / (ray * lines).sum(axis=1)
            beside = np.linalg.norm(ray * there[:, None] - away, axis=1)
        covers = beside <= radius  # False where the ray runs along the disc
        if down == aside == 0:
            there, covers = np.where(covers, there, depth), np.ones(len(at), dtype=bool)
        drawn.append(((pixels[:, 0] * width + pixels[:, 1])[covers], there[covers]))
    where, depths = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    order = np.argsort(-depths, kind="stable")  # of several written to one place, the last stays: the nearest
    image_of = np.full((int(at[:, 0].max()) + reach + 1) * width, np.inf)
    image_of[where[order]] = depths[order]
    steep = np.abs(_cosines(away, lines)).clip(0.2, 1.0)
    own = np.sqrt(1.0 - steep**2) / steep * 0.7 * pixel * depth
    seen: BoolArray = depth <= image_of[at[:, 0] * width + at[:, 1]] + _SLACK * size + own
    return seen

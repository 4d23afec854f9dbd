"""What a simulator lets things touch: boxes about their surface, and what carries them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from regnf_core.importing.families.facing import winding_number

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

CELLS = 28
"""Cells along a thing's longest edge."""
DENSITY = 300.0
"""Of boxes, kg/m^3: furniture with its hollows."""
_MOST_CELLS = 250
"""Along the longest edge of what nothing explains: memory."""
_STEP = 0.5
"""Largest distance of the points that stand for a surface, in cells."""
_INSIDE = 0.75
"""Winding number from which on a place is inside: a closed surface has 1 there, an open bowl up to about 0.5."""
_SAME, _LEAST, _INSET = 1.0 / 8.0, 1.0 / 4.0, 1.0 / 20.0
"""In cells: by how much ends of columns may differ to be one box, a box's least edge, what its free sides lose."""
_FLAT = 0.02
"""What is less wide than this, in cells, is a face."""
_GIVEN = 1.25
"""So many cells a side gives way at most: a cell, and what a pose is wrong by."""
_GAP, _GAP_SHARE = 0.03, 0.05
"""A thing is carried by what lies at most so far beneath its lowest points: meters, or a share of its height."""
_FEET = 500
"""So many of these points are looked at, at most."""
LEVEL = 0.9
"""Least cosine between up and a floor's normal."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes with the same axes. axes: (3, 3) rotation whose columns they are · low, high: (B, 3) corners along them."""

    axes: Floats
    low: Floats
    high: Floats

    def __len__(self) -> int:
        return len(self.low)

    @property
    def centers(self) -> Floats:
        """(B, 3) in the frame in which the axes are given."""
        centers: Floats = (self.low + self.high) / 2.0 @ self.axes.T
        return centers

    @property
    def sizes(self) -> Floats:
        """(B, 3): full edges."""
        sizes: Floats = self.high - self.low
        return sizes

    def seen_from(self, R: Floats, t: Floats) -> Boxes:
        """The same boxes in the frame of a body that stands at rotation ``R`` (3, 3) and place ``t`` (3,)."""
        axes = R.T @ self.axes
        shift = t @ self.axes
        return Boxes(axes, self.low - shift, self.high - shift)

    def mass_properties(self) -> tuple[float, Floats, Floats]:
        """Mass in kg, center (3,) and inertia (3, 3) about it, of boxes in meters that do not overlap."""
        masses = DENSITY * np.prod(self.sizes, axis=1)
        mass, squares = float(masses.sum()), self.sizes**2 / 12.0
        center = masses @ self.centers / mass
        own = self.axes @ np.diag(masses @ squares) @ self.axes.T
        off = self.centers - center
        second = own + np.einsum("b,bi,bj->ij", masses, off, off)
        return mass, center, np.trace(second) * np.eye(3) - second


def surface_points(vertices: Floats, faces: Integers, step: float) -> Floats:
    """(N, 3): the corners, and the middles of edges longer than ``step``, of which triangles are halved until none is.

    The longest edge comes first, so that a long, narrow triangle gives few points.
    """
    triangles = vertices[faces]
    found = [vertices[np.unique(faces)]]
    while len(triangles):
        lengths = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        large = lengths.max(axis=1) > step
        triangles, longest = triangles[large], lengths[large].argmax(axis=1)
        turn = (longest[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles, turn[..., None], axis=1), 1, 0)
        middle = (a + b) / 2.0
        found.append(middle)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(found)


def mesh_boxes(vertices: Floats, faces: Integers) -> tuple[Boxes, Floats]:
    """Boxes that fill a mesh, upright along z, and points (N, 3) of its surface; z is up, unit as the vertices.

    Cells are along the footprint's narrowest rectangle. The lowest layer ends at one height, so that feet stand even.
    """
    axes = _footprint_axes(vertices[np.unique(faces)])
    turned = vertices @ axes
    used = turned[np.unique(faces)]
    low, edges = used.min(axis=0), np.ptp(used, axis=0)
    cell = float(edges.max()) / CELLS
    points = surface_points(turned, faces, _STEP * cell)
    shape = np.maximum(np.ceil(edges / cell - 1e-6), 1).astype(np.int64)
    cells = np.where(edges > 0.01 * cell, edges / shape, cell)
    centers = low + (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5) * cells
    inside = (np.abs(winding_number(turned, faces, centers.reshape(-1, 3))) > _INSIDE).reshape(shape)
    corners = _merged(points, low, cells, inside, level=True)
    return Boxes(axes, *corners), points @ axes.T


def point_boxes(points: Floats, cell: float) -> Boxes:
    """Boxes about points (N, 3) of surfaces; z is up."""
    if not len(points):
        return Boxes(np.eye(3), np.zeros((0, 3)), np.zeros((0, 3)))
    low = points.min(axis=0)
    cell = max(cell, float(np.ptp(points, axis=0).max()) / _MOST_CELLS)
    shape = np.floor(np.ptp(points, axis=0) / cell).astype(np.int64) + 1
    return Boxes(np.eye(3), *_merged(points, low, np.full(3, cell), np.zeros(shape, bool), level=False))


def slab(normal: Floats, offset: float, center: Floats, radius: float, thickness: float = 0.5) -> Boxes:
    """A static plate behind a plane n . x = offset, about the place on it that is nearest to ``center`` (3,)."""
    axes = np.linalg.svd(normal[None])[2].T[:, [1, 2, 0]]
    axes[:, 2] = normal
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    middle = center @ axes
    low, high = middle - radius, middle + radius
    low[2], high[2] = offset - thickness, offset
    return Boxes(axes, low[None], high[None])


def apart(boxes: Boxes, other: Boxes) -> Boxes:
    """Upright boxes without what their cells have too much at their sides, where that reaches into another thing.

    A side recedes by little more than a cell, and only where the boxes overlap less along it than in height.
    """
    cell = float(np.ptp([boxes.low.min(axis=0), boxes.high.max(axis=0)], axis=0).max()) / CELLS
    turn = np.abs(boxes.axes.T @ other.axes)
    middle, half = other.centers @ boxes.axes, other.sizes / 2.0 @ turn.T
    at_high = boxes.high[:, None] - (middle - half)  # (B, O, 3)
    at_low = (middle + half) - boxes.low[:, None]
    into = np.minimum(at_high, at_low)
    off = np.abs(boxes.centers[:, None] @ other.axes - other.centers @ other.axes)
    meets = (into > 0.0).all(-1) & (off < (boxes.sizes / 2.0 @ turn)[:, None] + other.sizes / 2.0).all(-1)
    axis = into[..., :2].argmin(axis=-1)
    least = into[..., :2].min(axis=-1)
    meets &= (least <= _GIVEN * cell) & (least < into[..., 2])
    low, high = boxes.low.copy(), boxes.high.copy()
    for b, o in np.argwhere(meets).tolist():
        k = int(axis[b, o])
        if at_high[b, o, k] <= at_low[b, o, k]:
            high[b, k] = min(high[b, k], boxes.high[b, k] - at_high[b, o, k])
        else:
            low[b, k] = max(low[b, k], boxes.low[b, k] + at_low[b, o, k])
    left = (high - low > _LEAST * cell / 4.0).all(axis=1)
    return Boxes(boxes.axes, low[left], high[left]) if left.any() else boxes


def carried(points: Floats, others: Sequence[Boxes]) -> bool:
    """Whether one of the others lies just beneath the lowest of a thing's points (N, 3); z is up."""
    lowest, height = points[:, 2].min(), np.ptp(points[:, 2])
    gap = max(_GAP, _GAP_SHARE * height)
    feet = points[points[:, 2] <= lowest + gap / 2.0]
    feet = feet[np.argsort(feet[:, 2])][:: len(feet) // _FEET + 1]
    for other in others:
        if other.axes[2, 2] < LEVEL or not len(other):
            continue
        local = (feet @ other.axes)[:, None]  # (F, 1, 3)
        above = (local >= other.low)[..., :2].all(-1) & (local <= other.high)[..., :2].all(-1)
        if (above & (np.abs(local[..., 2] - other.high[:, 2]) <= gap)).any():
            return True
    return False


def _footprint_axes(points: Floats) -> Floats:
    """(3, 3): columns are axes of the rectangle of least area about points seen from above, and z."""
    axes = np.eye(3)
    try:
        hull = ConvexHull(points[:, :2])
    except QhullError:  # all on a line, seen from above
        axis = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), full_matrices=False)[2][:1]
        sides = axis
    else:
        sides = hull.equations[:, :2]
    across = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
    areas = np.ptp(points[:, :2] @ sides.T, axis=0) * np.ptp(points[:, :2] @ across.T, axis=0)
    best = int(np.argmin(np.round(areas / max(areas.max(), 1e-300), 6)))
    axes[:2, 0], axes[:2, 1] = sides[best], across[best]
    return axes


def _cells(points: Floats, low: Floats, cells: Floats, shape: Integers) -> Integers:
    """(N, 3): which cell each point lies in."""
    return np.clip(np.floor((points - low) / cells).astype(np.int64), 0, shape - 1)


def _off_edges(points: Floats, index: Integers, low: Floats, cells: Floats, inside: Mask, axis: int) -> Integers:
    """The cells of the points, where a face between two cells belongs to the one that has more than that face."""
    place = (points[:, axis] - low[axis]) / cells[axis] - index[:, axis]
    least, most = np.full(inside.shape, np.inf), np.full(inside.shape, -np.inf)
    np.minimum.at(least, tuple(index.T), place)
    np.maximum.at(most, tuple(index.T), place)
    wide = np.pad((most - least > _FLAT) | inside, 1)
    moved = index.copy()
    for side, at in ((-1, most < _FLAT), (1, least > 1.0 - _FLAT)):
        beside = np.roll(wide, -side, axis=axis)[1:-1, 1:-1, 1:-1]
        moved[:, axis] += side * (at & beside & ~wide[1:-1, 1:-1, 1:-1])[tuple(index.T)]
    return moved


def _merged(points: Floats, low: Floats, cells: Floats, inside: Mask, level: bool) -> tuple[Floats, Floats]:
    """Corners (B, 3) of boxes about all cells (X, Y, Z) that are inside or hold a point.

    1. Cells above each other are one column, which ends where its points end: tops and feet are exact.
    2. A column's free sides end at its points as well.
    3. Columns side by side whose ends agree are one box.
    """
    shape = np.array(inside.shape)
    index = _cells(points, low, cells, shape)
    for axis in (0, 1):
        index = _off_edges(points, index, low, cells, inside, axis)
    flat = np.ravel_multi_index(tuple(index.T), inside.shape)
    taken = inside.copy()
    taken.reshape(-1)[flat] = True
    held = np.flatnonzero(taken)
    where = np.stack(np.unravel_index(held, inside.shape), axis=1)
    least, most = np.full((2, len(held), 3), np.inf) * np.array([1.0, -1.0])[:, None, None]
    slot = np.searchsorted(held, flat)
    np.minimum.at(least, slot, points)
    np.maximum.at(most, slot, points)
    corner = low + where * cells
    empty = ~np.isfinite(least[:, 0])
    least[empty], most[empty] = corner[empty], (corner + cells)[empty]

    ringed = np.pad(taken, 1)
    begins = np.flatnonzero(~ringed[tuple((where + np.array([1, 1, 0])).T)])
    lowest, highest = np.minimum.reduceat(least, begins), np.maximum.reduceat(most, begins)
    if level:
        lowest[where[begins, 2] == 0, 2] = low[2]
    count = np.diff(np.append(begins, len(held)))
    edge = low + where[begins] * cells
    for axis in (0, 1):
        for side in (-1, 1):
            step = np.eye(3, dtype=np.int64)[axis] * side + 1
            joined = np.add.reduceat(ringed[tuple((where + step).T)].astype(np.int64), begins) * 2 >= count
            inset = _INSET * cells[axis]
            if side < 0:
                lowest[:, axis] = np.where(joined, edge[:, axis], lowest[:, axis] + inset)
            else:
                highest[:, axis] = np.where(joined, edge[:, axis] + cells[axis], highest[:, axis] - inset)
    thin = np.maximum(_LEAST * cells.max() - (highest - lowest), 0.0)
    lowest[:, :2] -= thin[:, :2] / 2.0
    highest[:, :2] += thin[:, :2] / 2.0
    on_floor = (lowest[:, 2] <= low[2]) & level
    highest[:, 2] += np.where(on_floor, thin[:, 2], 0.0)
    lowest[:, 2] -= np.where(on_floor, 0.0, thin[:, 2])
    groups = _rectangles(where[begins, :2], np.stack([lowest[:, 2], highest[:, 2]], axis=1), _SAME * cells[2])
    found = np.array([[lowest[group].min(axis=0), highest[group].max(axis=0)] for group in groups])
    for box, group in zip(found, groups, strict=True):
        box[:, 2] = lowest[group, 2].mean(), highest[group, 2].mean()
    return found[:, 0], found[:, 1]


def _rectangles(places: Integers, ends: Floats, same: float) -> list[list[int]]:
    """Columns at cells (N, 2) with ends (N, 2) in groups that fill rectangles and end alike."""
    at: dict[tuple[int, int], list[int]] = {}
    for number, (i, j) in enumerate(places.tolist()):
        at.setdefault((i, j), []).append(number)
    free = [True] * len(places)

    def alike(first: int, place: tuple[int, int]) -> int:
        near = (n for n in at.get(place, ()) if free[n] and (np.abs(ends[n] - ends[first]) <= same).all())
        return next(near, -1)

    groups = []
    for first, (i, j) in enumerate(places.tolist()):
        if not free[first]:
            continue
        row = [first]
        while (found := alike(first, (i, j + len(row)))) >= 0:
            row.append(found)
        group, width, depth = list(row), len(row), 1
        while min(row := [alike(first, (i + depth, j + k)) for k in range(width)]) >= 0:
            group += row
            depth += 1
        for number in group:
            free[number] = False
        groups.append(group)
    return groups

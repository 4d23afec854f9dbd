"""A place of the scene that is cleared: its matter taken away, the ground beneath and behind continued."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt, label
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from torch import Tensor

from regnf_core.editing.support import PlacedObject, SupportPlane, support_planes
from regnf_core.fields.observation import SdfField, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.schema.description import SURFACE

# The surface of a support, as heights above its plane: as the scene has it, and continued where an object stood.

Heights = NDArray[np.float64]
_ALONG = 64
"""Cells along the longer side of the box's footprint."""
_TOLERANCE = 0.02
"""Of the box's diagonal: heights beyond it are no longer the support's."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Heights over a plane in a rectangle around a box's footprint.

    origin: (3,), the middle of the first cell, on the plane · axes: (2, 3) unit, within it · cell: edge · heights:
    (A, B) float32 · missing: (A, B) distance to where the support goes on, 0 or less there; scene units.
    """

    plane: SupportPlane
    origin: Tensor
    axes: Tensor
    cell: float
    heights: Tensor
    missing: Tensor

    def distance(self, points: Tensor) -> Solid:
        """Of points (N, 3) to the support's matter, about."""
        at = (points - self.origin.to(points)) @ self.axes.to(points).T / self.cell
        height, slope = _sampled(self.heights, at)
        missing, away = _sampled(self.missing, at)
        above = self.plane.height(points) - height
        gradient = self.plane.normal.to(points) - (slope / self.cell) @ self.axes.to(points)
        beside = missing > above
        gradient = torch.where(beside[:, None], (away / self.cell) @ self.axes.to(points), gradient)
        return torch.maximum(above, missing), gradient


def ground_of(
    scene: SdfField, plane: SupportPlane, box: OrientedBox, belongs: Callable[[Tensor], Tensor] | None
) -> Ground | None:
    """The support in and round ``box``; None where the scene has nothing of it there.

    belongs: tells of points (N, 3) whether they are of the object, or so near to it that the surface there may be its
    own; None: that is not known. Heights are known where the scene's surface is near the plane, nothing stands on it,
    and it is not the object's; between, they solve Laplace's equation: a membrane fixed at what is known. A place that
    is free at the plane, and not enclosed by known ones, has no support: a table's top ends.
    """
    origin, axes, cell, counts = _rectangle(plane, box)
    index = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in counts))
    points = (origin + cell * index @ axes).float()
    distance = scene.signed_distance(points.to(scene.device)).double().cpu().numpy().reshape(counts)
    low, high = scene.bounds
    outside = ~((points >= low) & (points <= high)).all(-1).numpy().reshape(counts)
    own = np.zeros(counts, bool) if belongs is None else belongs(points).cpu().numpy().reshape(counts)
    tolerance = max(_TOLERANCE * box.diagonal, 4.0 * plane.roughness)
    above = (points + 1.5 * tolerance * plane.normal.float()).to(scene.device)
    bare = (scene.signed_distance(above) >= 0.75 * tolerance).cpu().numpy().reshape(counts)
    known = (np.abs(distance) <= tolerance) & bare & ~own & ~outside
    if known.sum() < 0.02 * known.size:
        return None
    free = (distance > tolerance) & ~own
    there = binary_fill_holes(~free) & ~outside
    heights = _membrane(np.where(known, -distance, 0.0), known)
    missing = np.full(counts, -1e3 * cell) if there.all() else signed_distance_to(there, cell)
    tensors = (torch.from_numpy(values.astype(np.float32)) for values in (heights, missing))
    return Ground(plane, origin, axes, cell, *tensors)


def _rectangle(plane: SupportPlane, box: OrientedBox) -> tuple[Tensor, Tensor, float, tuple[int, int]]:
    """Origin (3,), axes (2, 3), cell and counts of a grid on the plane that covers the box seen along its normal."""
    n = plane.normal
    along = box.rotation[:, int((box.rotation.T @ n).abs().argmin())]
    first = torch.nn.functional.normalize(along - (along @ n) * n, dim=0)
    axes = torch.stack([first, torch.linalg.cross(n, first)])
    corners = box.corners() @ axes.T
    low, high = corners.amin(0), corners.amax(0)
    cell = float((high - low).max()) / (_ALONG - 4)
    low, high = low - 2 * cell, high + 2 * cell
    a, b = (int(count) + 1 for count in ((high - low) / cell).ceil().tolist())
    return plane.offset * n + low @ axes, axes, cell, (a, b)


def _membrane(values: Heights, known: Mask) -> Heights:
    """Values (A, B) where known; elsewhere each is the mean of its neighbors."""
    number = np.full(values.shape, -1)
    unknown = ~known
    number[unknown] = np.arange(int(unknown.sum()))
    if not unknown.any():
        return values
    rows, columns, weights = [], [], []
    right = np.zeros(int(unknown.sum()))
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inside = np.ones(values.shape, bool)
        inside[(slice(None),) * axis + ((-1 if step == 1 else 0),)] = False
        here = unknown & inside
        there = np.roll(number, -step, axis)[here]
        me = number[here]
        between = there >= 0
        rows += [me, me[between]]
        columns += [me, there[between]]
        weights += [np.ones(len(me)), -np.ones(int(between.sum()))]
        np.add.at(right, me[~between], np.roll(values, -step, axis)[here][~between])
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    matrix = coo_matrix(entries, shape=(len(right), len(right))).tocsr()
    solved = values.copy()
    solved[unknown] = spsolve(matrix, right)
    return solved


def _sampled(values: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear values (N,) at places (N, 2) in cells, and their slopes (N, 2) a cell; constant beyond the grid."""
    values = values.to(at.device)
    most = torch.tensor(values.shape, device=at.device) - 1
    within = at.clamp_min(0.0).minimum(most.to(at))
    low = within.floor().long().minimum(most - 1)
    x, y = low.unbind(-1)
    u, v = (within - low).unbind(-1)
    a, b, c, d = values[x, y], values[x + 1, y], values[x, y + 1], values[x + 1, y + 1]
    value = (1 - u) * (1 - v) * a + u * (1 - v) * b + (1 - u) * v * c + u * v * d
    slope = torch.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], dim=-1)
    return value, slope


# What reaches into an object's box without being of it: a table's top over a chair, a wall, an object beside it.

_ALONG_THE_SURFACE, _AROUND = 72, 1.3
"""Cells along the longest edge, and how much larger than the box their region is."""
_LEAST_CELLS = 24
_LEAST_OUTSIDE = 0.3
"""Share of a component outside of the box from which on it is a neighbor, where the box alone says what is removed."""
_KEPT_AROUND = 2
"""Cells around a neighbor's surface that are kept with it."""


def kept_neighbors(
    scene: SdfField, box: OrientedBox, planes: Sequence[SupportPlane], of_thing: Callable[[Tensor], Tensor] | None
) -> GridDistance | None:
    """The signed distance to what is kept in ``box``, negative there; None where nothing is.

    of_thing: tells of points (N, 3) whether they are near the object's known surface; None: it is not known.
    The scene's matter is divided into connected components, without supports and without what is the object's. Those
    that go on outside of the box are neighbors; the rest is taken for the object's, or for noise. Where the scene knows
    what was observed, only what was measured counts: unobserved matter behind an object is not kept.
    """
    around = OrientedBox(box.center, box.size * _AROUND, box.rotation)
    grid = RegionGrid.over(around, _ALONG_THE_SURFACE)
    points = grid.points()
    distance = grid.cube(scene.signed_distance(points.to(scene.device)))
    matter = (distance < 0.25 * grid.cell) & (distance > -_KEPT_AROUND * 2 * grid.cell)
    thickness = 1.5 * grid.cell
    for plane in planes:
        matter &= grid.cube(plane.height(points)) > max(thickness, 4.0 * plane.roughness)
    if of_thing is not None:
        matter &= ~_mask(grid, of_thing(points))
    observation = observation_of(scene)
    if observation is not None:
        reach = max(1, round(observation.voxel / grid.cell))
        matter &= binary_dilation(_mask(grid, observation.at(points) == SURFACE), iterations=reach)
    inside = _mask(grid, box_distance(box, points) < 0.0)
    # the components of matter of which at least this share lies outside of the box
    least_outside = 1e-9 if of_thing is not None else _LEAST_OUTSIDE
    labels, count = label(matter, structure=np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    outside = np.bincount(labels[~inside], minlength=count + 1)
    neighbor = (sizes >= _LEAST_CELLS) & (outside >= np.maximum(1, least_outside * sizes))
    neighbor[0] = False
    kept = neighbor[labels]
    if not (kept & inside).any():
        return None
    return grid.distance_to(binary_dilation(kept, iterations=_KEPT_AROUND))


def _mask(grid: RegionGrid, values: Tensor) -> Mask:
    found: Mask = values.cpu().numpy().reshape(grid.shape)
    return found


_BOX_MARGIN = 0.05
"""How far beyond an object's box its copy in the scene may reach, as a share of the box's diagonal."""
_OWN_MARGIN = 0.015
"""The same of the object's surface, and 3 times the registration's residual."""
_OVERLAP = 0.004
"""Of the box's diagonal: the continued ground reaches so far into the matter around it, and leaves no gap."""


Solid = tuple[Tensor, Tensor]
"""Signed distances (N,) to a solid, and their gradients (N, 3)."""
Place = PlacedObject | OrientedBox


@dataclass(frozen=True, eq=False)
class Limits:
    """What a clearing makes of a scene's distances: min(max(distance, least), most).

    As solids: the scene less the box (but for what is kept), and the ground. most: None without ground.
    """

    least: Solid
    most: Solid | None

    def apply(self, scene: Solid) -> Solid:
        found = _larger(scene, self.least)
        return found if self.most is None else _smaller(found, self.most)


@dataclass(frozen=True, eq=False)
class Clearing:
    """box: what is cleared, but for ``kept`` · grounds: supports that go on through it."""

    box: OrientedBox
    kept: GridDistance | None
    grounds: Sequence[Ground]

    def reaches(self, points: Tensor) -> Tensor:
        """(N,) distance to what may be changed, negative within, less the overlap."""
        return box_distance(self.box, points) - _OVERLAP * self.box.diagonal

    def limits(self, points: Tensor, with_gradient: bool) -> Limits:
        """Between which the cleared scene's distance lies at points (N, 3), whatever the scene's own is.

        Without gradients the slopes mean nothing.
        """
        distance, outward = removed = self._box(points)
        if self.kept is not None:
            kept, slope = self.kept.at_with_gradient(points) if with_gradient else (self.kept.at(points), outward)
            removed = _larger(removed, (-kept, -slope))
        least = -removed[0], -removed[1]
        if not self.grounds:
            return Limits(least, None)
        ground = reduce(_smaller, (each.distance(points) for each in self.grounds))
        return Limits(least, _larger(ground, (distance - _OVERLAP * self.box.diagonal, outward)))

    def _box(self, points: Tensor) -> Solid:
        local = self.box.to_local(points)
        beyond = local.abs() - self.box.size.to(points) / 2.0
        out = beyond.clamp_min(0.0)
        outside = out.norm(dim=-1)
        deepest, axis = beyond.max(dim=-1)
        inward = torch.nn.functional.one_hot(axis, 3).to(points)
        slope = torch.where((deepest > 0)[:, None], out / outside.clamp_min(1e-12)[:, None], inward)
        slope = slope * torch.where(local < 0, -1.0, 1.0)
        return torch.where(deepest > 0, outside, deepest), slope @ self.box.rotation.to(points).T


@dataclass(frozen=True, eq=False)
class Unseen:
    """All of the scene is cleared, but for what is near surface that was measured. shell: the distance to that."""

    shell: GridDistance

    def reaches(self, points: Tensor) -> Tensor:
        """(N,): everywhere."""
        return torch.full_like(points[:, 0], -torch.inf)

    def limits(self, points: Tensor, with_gradient: bool) -> Limits:
        """As of a :class:`Clearing`."""
        if with_gradient:
            return Limits(self.shell.at_with_gradient(points), None)
        return Limits((self.shell.at(points), torch.zeros_like(points)), None)


def clear(scene: SdfField, removed: Place, residual: float, generator: torch.Generator) -> Clearing:
    """Clear the scene's copy of an object, or a box in which nobody knows the object's surface.

    residual: of the object's registration, scene units.
    """
    of_thing = removed.box if isinstance(removed, PlacedObject) else removed
    margin = _BOX_MARGIN * of_thing.diagonal + residual
    box = OrientedBox(of_thing.center, of_thing.size + 2.0 * margin, of_thing.rotation)
    planes = support_planes(scene, of_thing, generator)
    own = _OWN_MARGIN * of_thing.diagonal + 3.0 * residual
    thing = removed if isinstance(removed, PlacedObject) else None

    def near_thing(points: Tensor) -> Tensor:
        assert thing is not None
        return thing.signed_distance(points.to(thing.device)).to(points.device) < own

    belongs = None if thing is None else near_thing
    kept = kept_neighbors(scene, box, planes, belongs)
    grounds = (ground_of(scene, plane, box, belongs) for plane in planes)
    return Clearing(box, kept, [ground for ground in grounds if ground is not None])


def _larger(one: Solid, other: Solid) -> Solid:
    """What both solids share."""
    first = one[0] >= other[0]
    return torch.where(first, one[0], other[0]), torch.where(first[:, None], one[1], other[1])


def _smaller(one: Solid, other: Solid) -> Solid:
    """Both solids together."""
    first = one[0] <= other[0]
    return torch.where(first, one[0], other[0]), torch.where(first[:, None], one[1], other[1])


# A grid of points in and around a box, in the box's own axes.

Mask = NDArray[np.bool_]


def signed_distance_to(mask: Mask, cell: float) -> NDArray[np.float64]:
    """To the edge of the cells of ``mask``, negative in them; where there are none, or only these, about as far as the
    grid is wide."""
    most = float(np.linalg.norm(mask.shape))
    outside = distance_transform_edt(~mask) if mask.any() else most
    inside = distance_transform_edt(mask) if not mask.all() else most
    signed = np.clip(outside, 0.0, most) - np.clip(inside, 0.0, most)
    found: NDArray[np.float64] = (signed - 0.5 * np.sign(signed)) * cell
    return found


def box_distance(box: OrientedBox, points: Tensor) -> Tensor:
    """(N,) exact signed distance of points (N, 3) to a solid box, negative inside."""
    beyond = box.to_local(points).abs() - box.size.to(points) / 2.0
    outside: Tensor = beyond.clamp_min(0.0).norm(dim=-1)
    return outside + beyond.amax(-1).clamp_max(0.0)


@dataclass(frozen=True, eq=False)
class RegionGrid:
    """Cells of edge ``cell`` along the axes of ``box``, which they cover. shape: (3,) how many along each."""

    box: OrientedBox
    cell: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, box: OrientedBox, along_longest: int) -> RegionGrid:
        cell = float(box.size.max()) / along_longest
        x, y, z = (max(1, int(n)) for n in (box.size / cell).ceil().tolist())
        return cls(box, cell, (x, y, z))

    def points(self) -> Tensor:
        """(X * Y * Z, 3) float32, the cells' middles, frame of the box."""
        axes = [(torch.arange(n, dtype=torch.float64) + 0.5 - n / 2.0) * self.cell for n in self.shape]
        return (self.box.center + torch.cartesian_prod(*axes) @ self.box.rotation.T).float()

    def cube(self, values: Tensor) -> NDArray[np.float32]:
        """Values (X * Y * Z,) of the cells as (X, Y, Z)."""
        cube: NDArray[np.float32] = values.float().cpu().numpy().reshape(self.shape)
        return cube

    def distance_to(self, mask: Mask) -> GridDistance:
        """The signed distance to the cells of ``mask`` (X, Y, Z), negative in them."""
        return GridDistance(self, torch.from_numpy(signed_distance_to(mask, self.cell).astype(np.float32)))


@dataclass(frozen=True, eq=False)
class GridDistance:
    """Values at a grid's middles, interpolated between them and constant beyond. values: (X, Y, Z) float32."""

    grid: RegionGrid
    values: Tensor

    def at(self, points: Tensor) -> Tensor:
        """(N,) at points (N, 3) of the frame of the grid's box."""
        return self._sampled(self._places(points))

    def at_with_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) and the gradient (N, 3), by differences of half a cell."""
        places, step = self._places(points), 0.5
        slopes = []
        for axis in range(3):
            move = torch.zeros(3, device=places.device)
            move[axis] = step
            slopes.append((self._sampled(places + move) - self._sampled(places - move)) / (2 * step * self.grid.cell))
        local = torch.stack(slopes, dim=-1)
        return self._sampled(places), local @ self.grid.box.rotation.to(local).T

    def _places(self, points: Tensor) -> Tensor:
        half = torch.tensor(self.grid.shape, device=points.device) / 2.0
        return self.grid.box.to_local(points) / self.grid.cell + half - 0.5

    def _sampled(self, places: Tensor) -> Tensor:
        values = self.values.to(places.device)
        most = torch.tensor(values.shape, device=places.device) - 1
        places = places.clamp_min(0.0).minimum(most.to(places))
        low = places.floor().long().minimum((most - 1).clamp_min(0))
        share = places - low
        total = torch.zeros(len(places), device=places.device)
        for corner in range(8):
            bit = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=places.device)
            index = (low + bit).minimum(most)
            weight = torch.where(bit == 1, share, 1.0 - share).prod(-1)
            x, y, z = index.unbind(-1)
            total = total + weight * values[x, y, z]
        return total

"""Where things may stand in a scene, without a detector: boxes around pieces of its surface.

1. The surface of the whole scene is sampled evenly. Its boundary (floor, walls, ceiling) are planes with almost no
   other surface behind them; what remains is sampled more finely.
2. What remains is divided into small parts, and parts that touch are joined: first where the surface between them is
   flat or bulges, then at hollow creases, the longest relative to the parts first. Things that touch meet in a crease.
3. Each union that a clear crease, or nothing, joins to the rest is a proposal. So things that touch are proposed alone
   and together.
4. The same without the large flat patches on which things stand.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from regnf_core.fields.observation import SdfField, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.robust.constants import SAMPLING
from regnf_core.robust.working_frame import WorkingField, WorkingFrame
from regnf_core.schema.description import SURFACE
from regnf_core.surface.requirements import require_surface
from regnf_core.surface.result_clouds import project_to_surface
from regnf_core.surface.surface_cells import Cells, crop_to_surface, surface_cells

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# The surface of a whole scene.

_BASE, _LEVELS = 16, 4
"""Cells along the scene's longest edge; how often those near the surface are halved before the boundary is found."""
_MOST_HALVINGS, _MOST_SAMPLES = 2, 180_000
"""What is not boundary is halved further, so often at most, while there are no more samples than this."""


@dataclass(frozen=True, eq=False)
class BoundaryPlane:
    """A plane of the scene's boundary. normal: (3,) unit, into the scene · offset: n . x of its points."""

    normal: Floats
    offset: float

    def height(self, points: Floats) -> Floats:
        """(N,) of points (N, 3), positive within the scene."""
        heights: Floats = points @ self.normal - self.offset
        return heights


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """Samples of a scene's surface without its boundary. points, normals: (N, 3), scene frame · spacing: between
    samples, scene units · boundary: the planes, the largest first · cut: what is lower above them was left out."""

    points: Floats
    normals: Floats
    spacing: float
    boundary: list[BoundaryPlane] = field(default_factory=list)
    cut: float = 0.0

    def __len__(self) -> int:
        return len(self.points)


def scene_surface(scene: SdfField) -> SceneSurface:
    """Raises NoSurfaceError (NO_SURFACE_IN_SCENE), InvalidInputError (FIELD_NOT_FINITE)."""
    low, high = scene.bounds
    observation = observation_of(scene)
    measured = None if observation is None else observation.measured_extent()
    if measured is not None:
        low, high = torch.maximum(low, measured[0]), torch.minimum(high, measured[1])
    frame = WorkingFrame((low + high) / 2, float((high - low).max()))
    field = WorkingField(scene, frame)
    corners = crop_to_surface(field.value, frame.into(low).double(), frame.into(high).double(), _BASE)
    cells, space = surface_cells(field.value, *corners, _BASE, _LEVELS)

    def samples(of: Cells) -> tuple[Tensor, Tensor]:
        start = of.centers[of.values.abs() <= SAMPLING.max_cell_distance * of.edge].float()
        found = project_to_surface(field.value_and_gradient, start, 1, SAMPLING.min_slope)
        near = found.distance.abs() <= SAMPLING.max_sample_distance * of.edge
        near &= found.gradient.norm(dim=-1) >= SAMPLING.min_slope
        points, normals = found.points[near].double(), normalize(found.gradient[near].double(), dim=-1)
        outer = space.faces_outside(points, normals)
        points, normals = points[outer], normals[outer]
        if observation is not None:
            seen = observation.at(frame.out_of(points)) == SURFACE
            points, normals = points[seen], normals[seen]
        return points, normals

    points, normals = samples(cells)
    require_surface(len(points), of_object=False)
    planes = boundary_planes(points.numpy(), normals.numpy(), cells.edge)
    halvings, cut = 0, _THICK * cells.edge
    free = _off_boundary(points.numpy(), planes, cut)
    while halvings < _MOST_HALVINGS and 4 * free.sum() <= _MOST_SAMPLES:
        near = _off_boundary(cells.centers.numpy(), planes, cut)
        cells = cells[torch.from_numpy(near)].halved(field.value).near()
        points, normals = samples(cells)
        free = _off_boundary(points.numpy(), planes, cut)
        halvings += 1
    own = frame.out_of(points).numpy()[free]
    moved = [
        BoundaryPlane(one.normal, one.offset * frame.length + float(one.normal @ frame.center.numpy()))
        for one in planes
    ]
    return SceneSurface(own, normals.numpy()[free], cells.edge * frame.length, moved, cut * frame.length)


# Planes.

_TRIED, _ASKED, _FITS = 100, 8000, 2
"""Samples through which planes are tried; samples that are asked; fits of each plane to these."""
_THICK, _FACING = 1.5, 0.9
"""Spacings: half the thickness of a plane. Least cosine between its normal and those of its samples."""
_LEAST_ON_PLANE = 10
_MOST_PLANES = 8
_LEAST_SHARE, _MOST_BEHIND, _SPAN = 0.02, 0.4, 0.5
"""Of all samples, on a plane of the boundary; of these, so many behind it; of the scene's extent, along two axes."""


@dataclass(frozen=True, eq=False)
class _Planes:
    """K planes among N samples that are asked. normals: (K, 3) · offsets: (K,) · on: (N, K), which lie on them."""

    normals: Floats
    offsets: Floats
    on: Mask

    @classmethod
    def through(cls, points: Floats, normals: Floats, thick: float, rng: np.random.Generator) -> _Planes:
        """Planes through some of the samples (N, 3), fitted to those near them."""
        few = rng.permutation(len(points))[:_TRIED]
        n, offsets = normals[few], (normals[few] * points[few]).sum(1)
        for _ in range(_FITS):
            on = (np.abs(points @ n.T - offsets) <= thick) & (normals @ n.T >= _FACING)
            fits = [_fitted(points[mask], normal) for mask, normal in zip(on.T, n, strict=True)]
            n, offsets = np.array([fit[0] for fit in fits]), np.array([fit[1] for fit in fits])
        return cls(n, offsets, (np.abs(points @ n.T - offsets) <= thick) & (normals @ n.T >= _FACING))


def boundary_planes(points: Floats, normals: Floats, spacing: float) -> list[BoundaryPlane]:
    """Floor, walls and ceiling among samples (N, 3) with unit normals (N, 3), the largest first."""
    rng, thick = np.random.default_rng(0), _THICK * spacing
    asked = rng.permutation(len(points))[:_ASKED]
    points, normals = points[asked], normals[asked]
    found, rest = list[BoundaryPlane](), np.arange(len(points))
    while len(rest) and len(found) < _MOST_PLANES:
        tried = _Planes.through(points[rest], normals[rest], thick, rng)
        counts, heights = tried.on.sum(0), points @ tried.normals.T - tried.offsets
        # What faces the other way is the far side of the same floor or wall.
        behind = ((heights < -2 * thick) & (normals @ tried.normals.T > -_FACING)).sum(0)
        counts[behind > _MOST_BEHIND * counts] = 0
        counts[[not _spans(points[rest[mask]], points) for mask in tried.on.T]] = 0
        best = int(counts.argmax())
        if counts[best] < _LEAST_SHARE * len(points):
            break
        found.append(BoundaryPlane(tried.normals[best], float(tried.offsets[best])))
        rest = rest[heights[rest, best] > thick]
    return found


def _off_boundary(points: Floats, planes: Sequence[BoundaryPlane], cut: float) -> Mask:
    free = np.ones(len(points), bool)
    for one in planes:
        free &= one.height(points) > cut
    return free


def _spans(points: Floats, whole: Floats) -> bool:
    """Whether the points of a plane go on through much of the ``whole`` scene, along both of their axes."""
    if len(points) < _LEAST_ON_PLANE:
        return False
    middle = points.mean(0)
    axes = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 1:]
    own, all_ = (np.diff(np.quantile(one @ axes, [0.02, 0.98], axis=0), axis=0)[0] for one in (points, whole))
    return bool((own >= _SPAN * all_).all())


def _fitted(points: Floats, normal: Floats) -> tuple[Floats, float]:
    """The plane of least squares, its normal on the side of ``normal``; at infinity for too few points."""
    if len(points) < _LEAST_ON_PLANE:
        return normal, np.inf
    middle = points.mean(0)
    thinnest = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    thinnest = thinnest * (np.sign(thinnest @ normal) or 1.0)
    return thinnest, float(thinnest @ middle)


# Parts of a surface, and their unions.

_REACH, _ALIKE = 1.8, 0.5
"""Spacings within which samples are neighbors; least cosine of normals that are averaged."""
_ATOM = 4.0
"""Spacings: the edge of the cells that the smallest parts lie in."""
_FLAT = 0.05
"""Hollowness up to which a crease is not told from noise."""
_SOFT, _LONG = 0.3, 8
"""The most hollow of the pairs of neighbors between parts that belong together for sure, and how many there are."""
_LEAST_SAMPLES = 40
"""Of a proposal."""
_CLEAR = 0.05
"""Cost of a union from which on what it joins is proposed too."""


@dataclass(frozen=True, eq=False)
class Neighborhood:
    """Which samples are neighbors: pairs (E, 2), and how hollow (E,) the surface is between them: about 0 where it is
    flat, negative where it bulges, up to 2 where it faces itself."""

    points: Floats
    normals: Floats
    pairs: Integers
    hollow: Floats

    @classmethod
    def of(cls, points: Floats, normals: Floats, spacing: float) -> Neighborhood:
        pairs = cKDTree(points).query_pairs(_REACH * spacing, output_type="ndarray").astype(np.int64).reshape(-1, 2)
        a, b = pairs.T
        same = (normals[a] * normals[b]).sum(1) > _ALIKE
        graph = _graph(pairs[same], len(points))
        normals = normals + (graph + graph.T) @ normals
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        way = points[b] - points[a]
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        return cls(points, normals, pairs, ((normals[a] - normals[b]) * way).sum(1))

    def within(self, mask: Mask) -> Neighborhood:
        """The same of the samples that ``mask`` (N,) names."""
        number, kept = np.cumsum(mask) - 1, mask[self.pairs].all(1)
        return Neighborhood(self.points[mask], self.normals[mask], number[self.pairs[kept]], self.hollow[kept])


def _graph(pairs: Integers, count: int) -> coo_matrix:
    return coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()


def _components(pairs: Integers, count: int) -> Integers:
    """(N,): the number of the connected component of each."""
    found: Integers = connected_components(_graph(pairs, count), directed=False)[1].astype(np.int64)
    return found


def _atoms(near: Neighborhood, spacing: float) -> Integers:
    """(N,): the smallest part of each sample: cells of alike normals, joined where no crease is between them."""
    axis = np.abs(near.normals).argmax(1)
    side = np.take_along_axis(near.normals, axis[:, None], 1)[:, 0] > 0
    cells = np.floor(near.points / (_ATOM * spacing)).astype(np.int64)
    _, cell = np.unique(np.column_stack([cells, axis, side]), axis=0, return_inverse=True)
    cell = cell.ravel()
    atom = _components(near.pairs[cell[near.pairs[:, 0]] == cell[near.pairs[:, 1]]], len(near.points))
    contacts, lengths, mean, most = _contacts(near, atom)
    flat = (mean <= _FLAT) & (most <= _SOFT) & (lengths >= _LONG)
    return _components(contacts[flat], int(atom.max(initial=-1)) + 1)[atom]


def _contacts(near: Neighborhood, part: Integers) -> tuple[Integers, Integers, Floats, Floats]:
    """Pairs (C, 2) of parts that touch, the number (C,) of their pairs of neighbors, and how hollow (C,) the surface is
    between them on average, and at most."""
    a, b = part[near.pairs].T
    across = a != b
    low, high, count = np.minimum(a, b)[across], np.maximum(a, b)[across], int(part.max(initial=-1)) + 1
    numbers, which, lengths = np.unique(low * count + high, return_inverse=True, return_counts=True)
    totals = np.bincount(which.ravel(), weights=near.hollow[across], minlength=len(numbers))
    pairs = np.stack([numbers // max(count, 1), numbers % max(count, 1)], axis=1)
    most = np.full(len(numbers), -np.inf)
    np.maximum.at(most, which.ravel(), near.hollow[across])
    return pairs, lengths, totals / np.maximum(lengths, 1), most


def unions(near: Neighborhood, part: Integers) -> list[tuple[float, Integers]]:
    """Unions of parts (N,) that touch: what it costs to join each to more, infinite where nothing touches it; and the
    numbers of its samples.

    A contact of L pairs of neighbors with a mean hollowness h between parts of A and B samples costs
    h sqrt(min(A, B)) / L: little for flat and for long contacts. The cheapest are joined first.
    """
    count = int(part.max(initial=-1)) + 1
    size: list[int] = np.bincount(part, minlength=count).tolist()
    contact: list[dict[int, tuple[int, float]] | None] = [{} for _ in range(count)]
    queue: list[tuple[float, int, int]] = []

    def touch(one: int, other: int, length: int, total: float) -> None:
        mine, its = contact[one], contact[other]
        assert mine is not None
        assert its is not None
        mine[other] = its[one] = (length, total)
        cost = max(_FLAT, total / length) * math.sqrt(min(size[one], size[other])) / length
        queue.append((cost, one, other)) if not heaped else heapq.heappush(queue, (cost, one, other))

    heaped = False
    contacts, lengths, mean, _ = _contacts(near, part)
    for (one, other), length, hollow in zip(contacts.tolist(), lengths.tolist(), mean.tolist(), strict=True):
        touch(one, other, length, length * hollow)
    heapq.heapify(queue)
    heaped = True
    made_of: list[tuple[int, int]] = []
    cost_of = [math.inf] * count
    while queue:
        cost, one, other = heapq.heappop(queue)
        mine, its = contact[one], contact[other]
        if mine is None or its is None:
            continue
        cost_of[one] = cost_of[other] = cost
        contact[one] = contact[other] = None
        new = len(contact)
        contact.append({})
        cost_of.append(math.inf)
        size.append(size[one] + size[other])
        made_of.append((one, other))
        for third in {*mine, *its} - {one, other}:
            both = [said[third] for said in (mine, its) if third in said]
            theirs = contact[third]
            assert theirs is not None
            theirs.pop(one, None)
            theirs.pop(other, None)
            touch(new, third, sum(length for length, _ in both), sum(total for _, total in both))
    return _worth_proposing(part, count, made_of, size, cost_of)


def _worth_proposing(
    part: Integers, count: int, made_of: list[tuple[int, int]], size: list[int], cost_of: list[float]
) -> list[tuple[float, Integers]]:
    """The samples of the parts and unions that a clear crease divides from the rest."""
    order = np.argsort(part, kind="stable")
    of_part = np.split(order, np.cumsum(np.bincount(part, minlength=count))[:-1])

    def samples_of(number: int) -> Integers:
        left, parts = [number], []
        while left:
            one = left.pop()
            if one < count:
                parts.append(of_part[one])
            else:
                left += made_of[one - count]
        return np.concatenate(parts)

    chosen = [n for n, cost in enumerate(cost_of) if cost >= _CLEAR and size[n] >= _LEAST_SAMPLES]
    return [(cost_of[number], samples_of(number)) for number in chosen]


_PATCH, _MOST_PATCHES = 400, 12
"""Samples of a flat patch that things may stand on, lean on or hang from, at least; planes that are looked at."""


def flat_patches(near: Neighborhood, spacing: float) -> Mask:
    """(N,): which samples lie on large flat patches."""
    rng, thick, count = np.random.default_rng(0), _THICK * spacing, len(near.points)
    on, left = np.zeros(count, bool), np.ones(count, bool)
    for _ in range(_MOST_PATCHES):
        asked = rng.permutation(np.flatnonzero(left))[:_ASKED]
        if not len(asked):
            break
        tried = _Planes.through(near.points[asked], near.normals[asked], thick, rng)
        best = int(tried.on.sum(0).argmax())
        normal, offset = tried.normals[best], tried.offsets[best]
        flat = left & (np.abs(near.points @ normal - offset) <= thick) & (near.normals @ normal > _ALIKE)
        if flat.sum() < _PATCH:
            break
        left &= ~flat
        patch = near.within(flat)
        label = _components(patch.pairs, len(patch.points))
        on[np.flatnonzero(flat)[(np.bincount(label) >= _PATCH)[label]]] = True
    return on


# Proposals.

_SAME = 0.8
"""Share of the samples of either of two proposals that both have, from which on they are one."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """box: around the samples (their numbers among those of the scene's surface) · cost: of joining them to more."""

    box: OrientedBox
    samples: Integers
    cost: float


def proposals(surface: SceneSurface, free: Mask, most: int, known: Sequence[Integers] = ()) -> list[Proposal]:
    """At most ``most``, those that are clearest divided from the rest first, and of these the largest.

    free: (N,), which samples of the surface are still to be explained · known: samples of earlier proposals, which are
    not made again.
    """
    numbers = np.flatnonzero(free)
    if len(numbers) < _LEAST_SAMPLES:
        return []
    whole = Neighborhood.of(surface.points[numbers], surface.normals[numbers], surface.spacing)
    found = []
    for mask in (np.ones(len(numbers), bool), ~flat_patches(whole, surface.spacing)):
        near, own = whole.within(mask), numbers[mask]
        found += [(cost, own[samples]) for cost, samples in unions(near, _atoms(near, surface.spacing))]
    found.sort(key=lambda one: (-one[0], -len(one[1])))
    kept, taken = list[Proposal](), list(known)
    for cost, samples in found:
        if len(kept) == most:
            break
        if not any(_same(samples, other) for other in taken):
            taken.append(samples)
            kept.append(Proposal(_box(surface, samples), samples, cost))
    return kept


def pieces(surface: SceneSurface, free: Mask) -> Iterator[Proposal]:
    """The connected pieces of the samples that ``free`` (N,) names, the largest first."""
    numbers = np.flatnonzero(free)
    if not len(numbers):
        return
    near = Neighborhood.of(surface.points[numbers], surface.normals[numbers], surface.spacing)
    label = _components(near.pairs, len(numbers))
    sizes = np.bincount(label)
    for piece in np.argsort(-sizes, kind="stable")[: int((sizes >= _LEAST_SAMPLES).sum())]:
        samples = numbers[label == piece]
        yield Proposal(_box(surface, samples), samples, math.inf)


def _box(surface: SceneSurface, samples: Integers) -> OrientedBox:
    """The smallest box around samples that has an axis across one of the scene's boundary planes."""
    across: list[Floats] = []
    for normal in (*(one.normal for one in surface.boundary), np.array([0.0, 0.0, 1.0])):
        if all(abs(float(normal @ other)) < _FACING for other in across):
            across.append(normal)
    boxes = [box_around(surface.points[samples], normal, surface.spacing) for normal in across]
    return min(boxes, key=lambda box: float(box.size.prod()))


def _same(one: Integers, other: Integers) -> bool:
    if min(len(one), len(other)) < _SAME * max(len(one), len(other)):
        return False
    common = len(np.intersect1d(one, other, assume_unique=True))
    return common >= _SAME * (len(one) + len(other) - common)


def box_around(points: Floats, up: Floats, margin: float) -> OrientedBox:
    """The smallest box around points (N, 3) with an axis along ``up`` (3,), ``margin`` larger on each side."""
    first = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    flat = points @ np.stack([first, second], axis=1)
    try:
        corners = flat[ConvexHull(flat).vertices]
    except QhullError:
        corners = flat
    sides = np.roll(corners, -1, axis=0) - corners
    angles = np.unique(np.arctan2(sides[:, 1], sides[:, 0]) % (np.pi / 2))
    along = np.stack([np.cos(angles), np.sin(angles)])
    across = np.stack([-np.sin(angles), np.cos(angles)])
    areas = np.ptp(corners @ along, axis=0) * np.ptp(corners @ across, axis=0)
    x, y = along[:, int(areas.argmin())]
    side = x * first + y * second
    rotation = np.stack([side, np.cross(up, side), up], axis=1)
    local = points @ rotation
    low, high = local.min(0), local.max(0)
    center, size = rotation @ ((low + high) / 2), high - low + 2 * margin
    return OrientedBox(torch.from_numpy(center), torch.from_numpy(size), torch.from_numpy(rotation))

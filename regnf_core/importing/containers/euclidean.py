"""Distances to the surface in place of projective ones, for maps fused from depth images.

A fused map measures along the cameras' axes. At a surface that was seen at an angle its values are larger than the
distance, by 1 / cos of the angle: twice as large in the median of rooms that a camera walked through. Noise makes them
larger too. No distance is larger than the one to the surface which the values themselves cross zero at, so that is the
bound that they are cut to. The surface stays where it is, and values within the bound stay as they are.

Where nothing says which length the value 1 stands for, the surface alone gives the distances: the place where values
cross zero is the same whatever they were divided by.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from regnf_core.importing.arrays import Float32Array, tensor_error
from regnf_core.schema.similarity import local_origin

# What maps of voxel blocks share, whatever wrote them: unobserved voxels, the bounds, the weights.

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

_FAR_APART = 1e6
_VOXELS_AT_ONCE = 1 << 21
_LARGEST_WEIGHT = 60_000.0
"""float16 holds no number much beyond."""


def fill_unseen(values: Float32Array, seen: BoolArray, voxel_size: float, outward: int = 1) -> None:
    """Give voxels that were never seen the value of the nearest seen one of their block, plus the distance to it.

    So what was never seen is free space beyond what was seen. values, seen: (B, R, R, R), at least one voxel seen in
    each block; ``values`` is changed in place. outward: -1 where values are negative in free space.
    """
    from scipy import ndimage  # takes a moment to load, which most files need not wait for

    partial = np.flatnonzero(~seen.all(axis=(1, 2, 3)))
    at_once = max(1, _VOXELS_AT_ONCE // seen[0].size)
    for start in range(0, partial.size, at_once):
        chosen = partial[start : start + at_once]
        # One transform for many blocks: along the first axis they are so far apart that none sees into another.
        distance, nearest = ndimage.distance_transform_edt(
            ~seen[chosen], sampling=(_FAR_APART, 1.0, 1.0, 1.0), return_indices=True
        )
        values[chosen] = values[chosen][tuple(nearest)] + np.float32(outward * voxel_size) * distance.astype(np.float32)


def filled_nodes(values: Float32Array, seen: BoolArray, spacing: npt.NDArray[np.float64], outward: int) -> Float32Array:
    """The same of one grid (X, Y, Z), as a new array; its nodes are ``spacing`` (3,) apart."""
    from scipy import ndimage

    distance, nearest = ndimage.distance_transform_edt(~seen, sampling=tuple(spacing), return_indices=True)
    filled: Float32Array = values[tuple(nearest)] + np.float32(outward) * distance.astype(np.float32)
    return filled


def near_blocks(blocks: IntArray, length: float) -> tuple[IntArray, list[float] | None]:
    """Blocks (B, 3) of edge ``length`` with whole numbers subtracted where they lie far from the origin, and the place
    that was subtracted; None: nothing."""
    low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
    origin = local_origin([(length * corner).tolist() for corner in (low, high)])
    if origin is None:
        return blocks, None
    steps = np.round(np.array(origin) / length).astype(np.int64)
    return blocks - steps, (length * steps).tolist()


def seen_extent(blocks: IntArray, seen: BoolArray) -> tuple[IntArray, IntArray]:
    """The lowest and the highest node (3,) that was seen; node R b + i is voxel i of block b."""
    edge = seen.shape[1]
    low, high = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for axis, others in enumerate(((2, 3), (1, 3), (1, 2))):
        along: BoolArray = np.any(seen, axis=others)  # (B, R)
        first, last = along.argmax(axis=1), edge - 1 - along[:, ::-1].argmax(axis=1)
        low[axis] = (edge * blocks[:, axis] + first).min()
        high[axis] = (edge * blocks[:, axis] + last).max()
    return low, high


def require_shape_of_blocks(name: str, values: npt.NDArray[np.generic], blocks: int, edge: int) -> None:
    """Raise FieldFormatError (TENSOR_SHAPE) unless ``values`` has ``blocks`` blocks of ``edge``^3 voxels."""
    if values.shape != (blocks, edge, edge, edge):
        raise tensor_error(f"{name} has shape {values.shape}, expected {blocks} blocks of {edge}^3", "TENSOR_SHAPE")


def stored_weights(weights: Float32Array) -> npt.NDArray[np.float16]:
    """How much was seen of each voxel, as a field file keeps it: 0 where nothing was."""
    return np.clip(weights, 0.0, _LARGEST_WEIGHT).astype(np.float16)


Float64Array = npt.NDArray[np.float64]
_T = TypeVar("_T", bound=np.generic)

PROJECTIVE = (
    "the values are larger than the distance to the surface (projective distances); they were reduced to that distance"
)
"""Said of a file whose values were changed."""
_NEIGHBORS = 12
"""Crossings that a plane is laid through."""
_APART = 0.7
"""Voxels: no place of a surface is farther from the nearest crossing along it, but for noise."""
_AT_ONCE = 1 << 20
_FEWEST = 4
_TRIED, _LARGER, _SHARE = 20_000, 1.1, 0.05
"""Values of which so large a share is larger than their bound by so much are no distances. Exact ones in a grid are
off by less."""
_INNER, _OUTER = 0.3, 0.9
"""Values between which a node is neither at the surface nor cut off in some of the images."""
_BLOCKS, _FEWEST_RATIOS = 1_500, 200
_EVEN, _ROUND = 1.12, 0.05
"""Ratios as even as this, about a surface with normals to all sides, are of distances that are not projective."""
_MANY, _FEWEST_PAIRS, _FEWEST_RISES = 8, 64, 32
"""Of so many blocks some touch; fewer pairs of voxels at borders, or voxels at the surface, tell nothing."""
_TINY = 1e-30
_BROKEN, _BEND = 3.0, 0.2
"""Values bend at the border of a block at most so many times as much as within it and a share of a step's change."""
_ENDED, _FEWEST_ENDS = 0.5, 10
"""Of the surface at the borders of blocks, the share that may end there; fewer places tell nothing. Of 40 right maps
none ended anywhere, of those with mirrored indices and two layers of blocks all did."""
_FLAT, _STEEP = 0.7, 5.0
"""Slopes of fused maps at the surface: projective distances rise by 2 to 3 a unit in the median of rooms."""
_WHOLE = 0.05
"""Truncations are whole numbers of nodes, and are measured so well."""


def bound_by_surface(
    values: Float32Array, seen: BoolArray, blocks: IntArray, spacing: float | npt.NDArray[np.float64]
) -> bool:
    """Cut the values (B, X, Y, Z) that were seen to their distance from where they cross zero; changed in place.

    blocks: (B, 3), of as many nodes each: node (X, Y, Z) b + i is number i of block b · spacing: from node to node, of
    all axes or (3,) of each. Returns whether the values were larger: true distances stay to the last digit, and so do
    all values where fewer than four crossings are.
    """
    step = np.broadcast_to(np.asarray(spacing, np.float64), (3,))
    surface = _Surface.of(crossings(values, seen, blocks) * step, _APART * float(step.max()))
    if surface is None:
        return False
    seen_nodes = np.flatnonzero(seen)
    few = np.random.default_rng(0).choice(seen_nodes, min(_TRIED, len(seen_nodes)), replace=False)
    size, bound = _bounds(surface, values, blocks, few, step)
    if (size > _LARGER * bound).mean() <= _SHARE:
        return False
    flat = values.reshape(-1)
    for start in range(0, len(seen_nodes), _AT_ONCE):
        part = seen_nodes[start : start + _AT_ONCE]
        _, bound = _bounds(surface, values, blocks, part, step)
        flat[part] = np.clip(flat[part], -bound, bound)
    return True


def measure_from_surface(values: Float32Array, seen: BoolArray, blocks: IntArray, spacing: float, most: float) -> None:
    """Replace the values (B, R, R, R) that were seen, of any unit, by their distances from where they cross zero, cut
    off at ``most``; changed in place. Of values that cross zero nowhere, 1 becomes ``most``.

    blocks, spacing: see :func:`bound_by_surface`.
    """
    surface = _Surface.of(crossings(values, seen, blocks) * spacing, _APART * spacing)
    if surface is None:
        values *= np.float32(most)
        return
    seen_nodes, flat = np.flatnonzero(seen), values.reshape(-1)
    step = np.full(3, spacing)
    for start in range(0, len(seen_nodes), _AT_ONCE):
        part = seen_nodes[start : start + _AT_ONCE]
        distance = surface.distance(_places(part, values, blocks, step), most)
        flat[part] = np.copysign(np.minimum(distance, most), flat[part])


def length_of_one(values: Float32Array, seen: BoolArray, blocks: IntArray) -> float | None:
    """How many nodes wide the length is that the value 1 stands for, where the values (B, R, R, R), cut off at 1, are
    distances to the surface; None where they are projective, or too few to tell."""
    values, seen, blocks = _some(values, seen, blocks)
    surface = crossings(values, seen, blocks)
    chosen = np.flatnonzero(seen & (np.abs(values) > _INNER) & (np.abs(values) < _OUTER))
    if min(len(surface), len(chosen)) < _FEWEST_RATIOS:
        return None
    chosen = np.random.default_rng(0).choice(chosen, min(_TRIED, len(chosen)), replace=False)
    places, value = _places(chosen, values, blocks, np.ones(3)), values.reshape(-1)[chosen].astype(np.float64)
    distance, nearest = cKDTree(surface).query(places)
    ratios = distance / np.abs(value)
    low, ratio, high = (float(ratios_at) for ratios_at in np.quantile(ratios, [0.1, 0.5, 0.9]))
    normals = (places - surface[nearest]) / np.maximum(distance, 1e-9)[:, None]
    if high > _EVEN * low or np.linalg.eigvalsh(normals.T @ normals / len(normals))[0] < _ROUND:
        return None
    return float(round(ratio)) if abs(ratio - round(ratio)) <= _WHOLE * ratio else ratio


@np.errstate(all="ignore")  # numbers near the largest ones overflow, and are refused later
def doubts_of_map(
    values: Float32Array, seen: BoolArray, blocks: IntArray, spacing: float | npt.NDArray[np.float64] | None
) -> tuple[str, ...]:
    """Warnings of values (B, X, Y, Z) that do not go on from block to block, or rise by another factor than distances.

    blocks: see :func:`bound_by_surface` · spacing: the same, None for values of no known unit. Ask before it cuts them.
    """
    values, seen, blocks = _some(values, seen, blocks)
    rows, squares, bends, touching = _Rows(blocks), np.zeros(values.shape), [0.0], False
    step = np.broadcast_to(np.asarray(1.0 if spacing is None else spacing, np.float64), (3,))
    whole, changes = seen.copy(), np.zeros(seen.shape, np.bool_)
    alone: list[tuple[int, int, BoolArray]] = []  # axis, first or last layer, blocks with none beyond it
    for axis in range(3):
        alone.append((axis, 0, ~rows.of(blocks - np.eye(3, dtype=np.int64)[axis])[1]))
        beside, there = rows.of(blocks + np.eye(3, dtype=np.int64)[axis])
        beyond, both = _next(values, axis, beside), _next(seen, axis, beside)
        last, before = _at(axis, -1), _at(axis, -2)
        both[:, *last] &= there[:, None, None]
        both &= seen
        rise = beyond - values
        if values.shape[axis + 1] > 2:  # how the values bend at the border, and just before it
            known = both[:, *last] & both[:, *before] & seen[:, *_at(axis, -3)]
            turns = (rise[:, *last] - rise[:, *before], rise[:, *before] - rise[:, *_at(axis, -3)])
            at_border, inside = (float(np.abs(turn[known]).mean()) if known.any() else 0.0 for turn in turns)
            usual = float(np.abs(rise[both]).mean())
            bends.append(at_border / max(inside + _BEND * usual, _TINY) if known.sum() >= _FEWEST_PAIRS else 0.0)
        touching |= bool(there.any())
        alone.append((axis, -1, ~there))
        both[:, *last] = False
        whole, changes = whole & both, changes | (both & ((values < 0) != (beyond < 0)))
        squares += np.square(rise / step[axis])
    found: list[str] = []
    ended = [_ended(changes, [one for one in alone if one[0] == axis]) for axis in range(3)]
    if max(bends) > _BROKEN or (len(blocks) >= _MANY and (not touching or max(ended) > _ENDED)):
        text = "the values do not go on from block to block: the order of voxels or of block indices may be another one"
        found.append(f"AXES_UNCERTAIN: {text}")
    rises = np.sqrt(squares[whole & changes])
    slope = float(np.median(rises)) if len(rises) >= _FEWEST_RISES else 1.0
    if spacing is not None and not _FLAT <= slope <= _STEEP:
        text = f"the values rise by {slope:.2g} a unit at the surface: they or the voxel size may be of another unit"
        found.append(f"GRADIENT_NOT_UNIT: {text}")
    return tuple(found)


def _ended(changes: BoolArray, alone: list[tuple[int, int, BoolArray]]) -> float:
    """Of the places (B, X, Y, Z) where values change their sign at the borders of blocks, the share at those with no
    block beyond: maps have blocks all along their surface."""
    layers = [(changes[:, *_at(axis, layer)], missing) for axis, layer, missing in alone]
    at_border = sum(int(layer.sum()) for layer, _ in layers)
    return sum(int(layer[missing].sum()) for layer, missing in layers) / at_border if at_border >= _FEWEST_ENDS else 0.0


def _some(values: Float32Array, seen: BoolArray, blocks: IntArray) -> tuple[Float32Array, BoolArray, IntArray]:
    """At most so many blocks, near one another."""
    if len(blocks) <= _BLOCKS:
        return values, seen, blocks
    middle = blocks[np.random.default_rng(0).integers(len(blocks))]
    near = np.sort(np.argsort(np.square(blocks - middle).sum(axis=1), kind="stable")[:_BLOCKS])
    return values[near], seen[near], blocks[near]


def _places(chosen: IntArray, values: Float32Array, blocks: IntArray, step: Float64Array) -> Float64Array:
    """(M, 3) of the nodes number ``chosen`` (M,)."""
    at = np.unravel_index(chosen, values.shape)
    return np.asarray((np.array(values.shape[1:]) * blocks[at[0]] + np.stack(at[1:], axis=1)) * step, np.float64)


def _bounds(
    surface: _Surface, values: Float32Array, blocks: IntArray, chosen: IntArray, step: Float64Array
) -> tuple[Float32Array, Float32Array]:
    """The sizes of the values number ``chosen`` (M,), and their distances from the surface."""
    size = np.abs(values.reshape(-1)[chosen])
    nodes = _places(chosen, values, blocks, step)
    return size, surface.distance(nodes, float(size.max())).astype(np.float32)


def crossings(values: Float32Array, seen: BoolArray, blocks: IntArray) -> Float64Array:
    """Where the values change their sign between neighboring nodes that were seen (N, 3), in nodes."""
    rows, shape = _Rows(blocks), np.array(values.shape[1:])
    found: list[Float64Array] = []
    for axis in range(3):
        beside, there = rows.of(blocks + np.eye(3, dtype=np.int64)[axis])
        beyond, both = _next(values, axis, beside), _next(seen, axis, beside)
        both[:, *_at(axis, -1)] &= there[:, None, None]
        both &= seen
        crossing = np.argwhere(both & ((values < 0) != (beyond < 0)))
        at = tuple(crossing.T)
        places = (shape * blocks[crossing[:, 0]] + crossing[:, 1:]).astype(np.float64)
        places[:, axis] += values[at] / (values[at] - beyond[at])
        found.append(places)
    return np.concatenate(found)


def _next(voxels: npt.NDArray[_T], axis: int, beside: IntArray) -> npt.NDArray[_T]:
    """Of voxels (B, X, Y, Z) those that follow along an axis; the last ones' are in the blocks ``beside`` (B,)."""
    following = np.empty_like(voxels)
    following[:, *_at(axis, slice(None, -1))] = voxels[:, *_at(axis, slice(1, None))]
    following[:, *_at(axis, -1)] = voxels[:, *_at(axis, 0)][beside]
    return following


def _at(axis: int, where: int | slice) -> tuple[int | slice, ...]:
    return tuple(where if number == axis else slice(None) for number in range(3))


class _Rows:
    """Finds blocks by their indices."""

    def __init__(self, blocks: IntArray) -> None:
        self._low = blocks.min(axis=0)
        self._extent = blocks.max(axis=0) - self._low + 2
        numbers = self._numbers(blocks)
        self._order = np.argsort(numbers)
        self._sorted = numbers[self._order]

    def of(self, blocks: IntArray) -> tuple[IntArray, BoolArray]:
        """The rows (B,) of blocks (B, 3), at most one beyond the highest ones, and whether each is there."""
        numbers = self._numbers(blocks)
        at = np.searchsorted(self._sorted, numbers).clip(max=len(self._sorted) - 1)
        return self._order[at], self._sorted[at] == numbers

    def _numbers(self, blocks: IntArray) -> IntArray:
        x, y, z = (blocks - self._low).T
        numbers: IntArray = (x * self._extent[1] + y) * self._extent[2] + z
        return numbers


@dataclass(frozen=True, eq=False)
class _Surface:
    """Places (N, 3) of a surface, and normals of planes through those near each. apart: no place of the surface is
    farther from the nearest of them, but for noise."""

    places: Float64Array
    normals: Float64Array
    tree: cKDTree
    apart: float

    @classmethod
    def of(cls, places: Float64Array, apart: float) -> _Surface | None:
        """Of so many places; None of too few."""
        if len(places) < _FEWEST:
            return None
        tree, count = cKDTree(places), min(_NEIGHBORS, len(places))
        normals = np.empty_like(places)
        for start in range(0, len(places), _AT_ONCE // _NEIGHBORS):
            part = slice(start, start + _AT_ONCE // _NEIGHBORS)
            about = places[tree.query(places[part], k=count)[1]]
            about -= about.mean(axis=1, keepdims=True)
            normals[part] = np.linalg.eigh(about.transpose(0, 2, 1) @ about)[1][:, :, 0]
        return cls(places, normals, tree, apart)

    def distance(self, nodes: Float64Array, most: float) -> Float64Array:
        """(M,) of nodes (M, 3): from the plane of the nearest place, if it can be; infinite beyond ``most``."""
        straight, nearest = self.tree.query(nodes, distance_upper_bound=most + self.apart)
        away = np.isinf(straight)
        nearest[away] = 0
        along = np.abs(np.einsum("ni,ni->n", nodes - self.places[nearest], self.normals[nearest]))
        least = np.sqrt(np.maximum(np.square(straight) - self.apart**2, 0.0, where=~away, out=np.zeros_like(straight)))
        return np.where(away, np.inf, np.clip(along, least, straight))

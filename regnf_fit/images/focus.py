"""The region of a detection, from a few depth images, as finely as a pixel is wide there, in a fraction of a second.

A map of a room has voxels of a centimeter, and takes seconds. An object of 10 cm needs millimeters, in its own box
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product, zip_longest

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from regnf_core.errors import DatasetError
from regnf_core.fields.build import VoxelGridFunction
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import Observation, ObservedField, SdfField
from regnf_core.fields.user_fields import BoxExtension, FunctionField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_data.recordings.recording import Frame
from regnf_fit.images.observing import pixel_planes

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Masks = Sequence[NDArray[np.bool_]]

_MOST_NODES = 1_000_000
_AT_ONCE = 1 << 15
"""Nodes: what is in use of them stays in the processor's cache."""
_SHARP = 0.25
"""The share of the measured pixels that are no wider at their surface than a voxel is."""
_PLANAR, _BESIDE = 3.0, 1.5
"""Voxels: how near the nearest pixel's plane tells side and distance; how far beside its point the plane holds."""
_BEHIND = 8.0
"""Voxels behind a surface that count as matter; what lies farther behind it was not seen."""
_AROUND = 8
"""Pixels around the region's picture, for the planes at its edge."""
_FEW, _TRIED, _PLANES, _PLANE_SHARE, _ALONG = 3000, 100, 3, 0.15, 0.8
"""Points beside the object that planes are looked for in, those that one is tried through, planes at most, the share of
the points on one, and the cosine between its normal and theirs."""
_MARGIN = 1.5
"""Voxels before a surface that are not called free yet, and as many standard deviations of the depth."""


@dataclass(frozen=True, eq=False)
class _View:
    """What one image measured in the region, in the region's frame. points, normals: (P, 3) · T_camera_region: (4, 4) ·
    K: (3, 3), of the part of the image that shows the region · depth: (H, W) of that part, 0 for none ·
    margin: (H, W), a standard deviation of the depth · told: (P,) 1 for points
    of the object of a detection, -1 for those beside it, 0 where the image has none."""

    points: Floats
    normals: Floats
    told: NDArray[np.int8]
    T_camera_region: Floats
    K: Floats
    depth: NDArray[np.float32]
    margin: NDArray[np.float32]


def focused_field(
    frames: Sequence[Frame], region: OrientedBox, voxel: float | None = None, spread: float = 0.0, things: Masks = ()
) -> SdfField:
    """Signed distances in ``region``, world frame and unit, with what the images have seen of it.

    objects: of the first frames, (H, W) each, where they show the object of a detection. What they show beside it hides
    and is in the way, but no camera observed the object there: its surface counts as unobserved.
    voxel: from node to node; None: as wide as a pixel of the sharper images is at its surface, or as the number of
    nodes asks: distances near the surface are those from the planes of the pixels, so that wide voxels cost little.
    spread: a standard deviation of depths from frame to frame, beside the noise of each.
    Raises DatasetError (DATASET_NOTHING_IN_BOUNDS) where no image measured a surface in the region.
    """
    T_region_world, half = region_frame(region)
    pairs = zip_longest(frames, things)
    views = [view for frame, thing in pairs if (view := _view(frame, T_region_world, half, thing)) is not None]
    if not views:
        raise DatasetError("no depth image shows a surface in the region", reason="DATASET_NOTHING_IN_BOUNDS")
    measured = ((one.points, one.normals, one.told) for one in views)
    points, normals, told = (np.concatenate(part) for part in zip(*measured, strict=True))
    edge = max(voxel or _pixel_width(views), float(np.prod(2.0 * half) / _MOST_NODES) ** (1.0 / 3.0))
    shape = tuple(int(n) for n in np.ceil(2.0 * half / edge) + 1)
    low = -half
    places, planes, nearest = _nearest(points, normals, low, edge, shape)
    axes = [(low[k] + edge * np.arange(shape[k])).astype(np.float32) for k in range(3)]
    values, free = np.empty(shape, np.float32), np.empty(shape, np.bool_)
    several = max(1, _AT_ONCE // (shape[1] * shape[2]))
    for start in range(0, shape[0], several):
        slab = slice(start, start + several)
        nodes = np.stack(np.meshgrid(axes[0][slab], *axes[1:], indexing="ij"), axis=-1).reshape(-1, 3)
        through, behind = _carved(nodes, views, edge, spread)
        place, plane = (each.take(nearest[slab].ravel(), axis=0) for each in (places, planes))
        found = _distances(nodes - place, plane, behind, edge)
        values[slab], free[slab] = (each.reshape(-1, *shape[1:]) for each in (found, through))
    told = np.where((told == 0) & _on_planes(points, normals, told, 2.0 * edge), np.int8(-1), told)
    observation = _observation(points, told, free, low, edge, shape)
    high = low + edge * (np.array(shape) - 1)
    origin, top, step = (torch.from_numpy(v.astype(np.float32)) for v in (low, high, np.full(3, edge)))
    function = BoxExtension(VoxelGridFunction(torch.from_numpy(values), origin, step), origin, top, 1.0)
    field = ObservedField(FunctionField(function, torch.from_numpy(np.stack([low, high]))), observation)
    return TransformedField(field, Sim3.from_matrix(T_region_world.tolist()))


def region_frame(region: OrientedBox) -> tuple[Floats, Floats]:
    """T_region_world (4, 4), whose axes are the region's and whose origin is its middle, and half of its size (3,)."""
    T = np.eye(4)
    T[:3, :3] = region.rotation.numpy().T
    T[:3, 3] = -T[:3, :3] @ region.center.numpy()
    return T, region.size.numpy() / 2.0


def surface_in(frame: Frame, T_region_world: Floats, half: Floats, around: float = 0.0) -> tuple[Floats, Floats]:
    """Points and normals (P, 3) that a frame measured in a region and ``around`` it, in the region's frame."""
    view = _view(frame, T_region_world, half + around)
    return (np.zeros((0, 3)), np.zeros((0, 3))) if view is None else (view.points, view.normals)


def _view(frame: Frame, T_region_world: Floats, half: Floats, thing: NDArray[np.bool_] | None = None) -> _View | None:
    """The pixels whose surface lies in the region; those that share a plane with too few others are left out: at edges
    sensors mix two depths."""
    T_region_camera = T_region_world @ frame.T_world_camera
    T_camera_region = np.asarray(np.linalg.inv(T_region_camera), np.float64)
    rows, columns = _part(frame, T_camera_region, half)
    depth, K = frame.depth[rows, columns], frame.camera.K.copy()
    K[:2, 2] -= columns.start, rows.start
    if not (depth > 0.0).any():
        return None
    planes = pixel_planes(depth, K)
    # A plane's own depth would cut the tops of curved surfaces: voxels average the noise.
    kept = np.where(planes.known, depth, np.float32(0.0))
    row, column = np.nonzero(kept > 0.0)
    local = np.empty((len(row), 3))
    local[:, 2] = kept[row, column]
    for axis, place in enumerate((column, row)):
        local[:, axis] = (place + 0.5 - K[axis, 2]) / K[axis, axis] * local[:, 2]
    points = local @ T_region_camera[:3, :3].T + T_region_camera[:3, 3]
    x, y, z = np.abs(points).T
    inside = (x <= half[0]) & (y <= half[1]) & (z <= half[2])
    if not inside.any():
        return None
    normals = planes.normals[row[inside], column[inside]].astype(np.float64) @ T_region_camera[:3, :3].T
    told = np.zeros(len(points), np.int8) if thing is None else np.where(thing[rows, columns][row, column], 1, -1)
    return _View(points[inside], normals, told[inside], T_camera_region, K, kept, planes.deviations)


def _part(frame: Frame, T_camera_region: Floats, half: Floats) -> tuple[slice, slice]:
    """Rows and columns of the image that show the region, and a few more; all of them where it reaches behind."""
    height, width = frame.depth.shape
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half @ T_camera_region[:3, :3].T + T_camera_region[:3, 3]
    if corners[:, 2].min() <= 0.0:
        return slice(0, height), slice(0, width)
    pixels = frame.camera.project(corners)
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - _AROUND, 0, [width - 1, height - 1])
    high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + _AROUND, low + 1, [width, height])
    return slice(low[1], high[1]), slice(low[0], high[0])


def _pixel_width(views: Sequence[_View]) -> float:
    """The width of a pixel of the sharper images at its surface."""
    depths = [(one.points @ one.T_camera_region[2, :3] + one.T_camera_region[2, 3]) / one.K[0, 0] for one in views]
    return float(np.quantile(np.concatenate(depths), _SHARP))


def _carved(
    nodes: NDArray[np.float32], views: Sequence[_View], edge: float, spread: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which nodes (N, 3) an image looked through, and which lie behind what one measured, in no image before it."""
    free, behind = np.zeros(len(nodes), np.bool_), np.zeros(len(nodes), np.bool_)
    for one in views:
        T, K = one.T_camera_region.astype(np.float32), one.K.astype(np.float32)
        local = nodes @ T[:3, :3].T + T[:3, 3]
        height, width = one.depth.shape
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            column = np.floor(local[:, 0] / local[:, 2] * K[0, 0] + K[0, 2])
            row = np.floor(local[:, 1] / local[:, 2] * K[1, 1] + K[1, 2])
            shown = (local[:, 2] > 0.0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = np.where(shown, row * width + column, 0).astype(np.int64)
        measured = one.depth.ravel()[pixel]
        shown &= measured > 0.0
        gap = measured - local[:, 2]
        free |= shown & (gap > _MARGIN * (edge + spread + one.margin.ravel()[pixel]))
        behind |= shown & (gap < 0.0)
    return free, behind & ~free


def _nearest(
    points: Floats, normals: Floats, low: Floats, edge: float, shape: tuple[int, ...]
) -> tuple[Singles, Singles, NDArray[np.int32]]:
    """Means (C, 3) of points and normals in voxels that hold some; which of these is nearest to nodes: (X, Y, Z)."""
    cells = np.clip(np.round((points - low) / edge).astype(np.int64), 0, np.array(shape) - 1)
    cell = np.ravel_multi_index(tuple(cells.T), shape)
    counts = np.bincount(cell, minlength=np.prod(shape))
    number = np.cumsum(counts > 0, dtype=np.int32) - np.int32(1)  # of the voxels that hold points
    of, count = number[cell], counts[counts > 0]

    def means(values: Floats) -> Singles:
        sums = [np.bincount(of, values[:, axis], minlength=len(count)) for axis in range(3)]
        return (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)

    places, planes = means(points), means(normals)
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-9)
    empty = (counts == 0).reshape(shape)
    x, y, z = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return places, planes, number[(x * shape[1] + y) * shape[2] + z]


def _distances(offset: Singles, planes: Singles, behind: NDArray[np.bool_], edge: float) -> Singles:
    """(N,): from the plane of the nearest voxel's mean point near the surface, from the point beyond. offset: from it;
    planes: their normals; (N, 3)."""
    (x, y, z), (a, b, c) = offset.T, planes.T
    apart, across = np.sqrt(x * x + y * y + z * z), x * a + y * b + z * c
    sign = np.where(behind & (apart <= _BEHIND * edge), np.float32(-1.0), np.float32(1.0))
    # Straight above a pixel's patch its plane tells the distance; beside the patch the point does.
    straight = apart * apart - across * across <= (_BESIDE * edge) ** 2
    far = sign * np.where(straight, np.abs(across), apart)
    return np.asarray(np.where(apart <= _PLANAR * edge, across, far), np.float32)


def _on_planes(points: Floats, normals: Floats, told: NDArray[np.int8], within: float) -> NDArray[np.bool_]:
    """(P,): on a plane that holds much of what lies beside the object, as a table, and little of the object: what such
    a plane shows to other images, where the object hid it, is not the object's either."""
    out = np.zeros(len(points), np.bool_)
    beside, thing = np.flatnonzero(told < 0), told > 0
    if not len(beside) or not (told == 0).any():
        return out
    left = np.random.default_rng(0).permutation(beside)[:_FEW]
    total = len(left)
    for _ in range(_PLANES):
        if len(left) < _PLANE_SHARE * total:
            break
        tried = normals[left[:_TRIED]]
        offsets = np.einsum("tc,tc->t", tried, points[left[:_TRIED]])
        on = (np.abs(points[left] @ tried.T - offsets) <= within) & (normals[left] @ tried.T >= _ALONG)
        best = int(on.sum(axis=0).argmax())
        if on[:, best].sum() < _PLANE_SHARE * total:
            break
        there = (np.abs(points @ tried[best] - offsets[best]) <= within) & (normals @ tried[best] >= _ALONG)
        if there[thing].mean() < _PLANE_SHARE:
            out |= there
        left = left[~on[:, best]]
    return out


def _observation(
    points: Floats, told: NDArray[np.int8], free: NDArray[np.bool_], low: Floats, edge: float, shape: tuple[int, ...]
) -> Observation:
    """Voxels of two nodes' edge: free where all their nodes are, a surface where a point lies, but for those where
    points beside the object lie and none of it."""
    counts = tuple(max(1, -(-(n - 1) // 2)) for n in shape)
    states = np.full(counts, UNSEEN, np.uint8)
    padded = np.zeros(tuple(2 * n for n in counts), np.bool_)
    padded[tuple(slice(0, min(s, 2 * n)) for s, n in zip(shape, counts, strict=True))] = free[
        tuple(slice(0, 2 * n) for n in counts)
    ]
    padded = padded[::2] & padded[1::2]
    padded = padded[:, ::2] & padded[:, 1::2]
    states[padded[..., ::2] & padded[..., 1::2]] = FREE
    cells = np.floor((points - low) / (2.0 * edge)).astype(np.int64)
    within = ((cells >= 0) & (cells < np.array(counts))).all(axis=1)
    surfaces = np.zeros((3, *counts), np.bool_)
    for layer, which in enumerate((0, -1, 1)):
        surfaces[layer][tuple(cells[within & (told == which)].T)] = True
    shown, beside, thing = surfaces
    somebody = shown
    if thing.any():  # what other images show may be the object's where it goes on from what the detection shows
        somebody = shown & ~ndimage.binary_dilation(beside, iterations=2)
        pieces, _ = ndimage.label(somebody | thing, np.ones((3, 3, 3)))
        somebody &= np.isin(pieces, np.unique(pieces[thing]))
        states[beside | shown] = UNSEEN
    states[somebody | thing] = SURFACE
    return Observation(torch.from_numpy(states), torch.from_numpy(low.copy()), 2.0 * edge, of_thing=bool(thing.any()))

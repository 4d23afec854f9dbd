"""The region of a detection, made from a few depth images as finely as a pixel is wide there: in a fraction of a second.

A map of a room has voxels of a centimeter, and takes seconds. A thing of 10 cm needs millimeters, in its own box alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from regnf_core.errors import DatasetError
from regnf_core.fields.build import VoxelGridFunction
from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.fields.user_fields import BoxExtension, FunctionField
from regnf_core.geometry.box import OrientedBox
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_data.recordings.recording import Frame
from regnf_fit.images.observing import pixel_planes

Floats = NDArray[np.float64]

_MOST_NODES = 4_000_000
_SHARP = 0.25
"""The share of the measured pixels that are no wider at their surface than a voxel is."""
_PLANAR = 3.0
"""Voxels from the surface up to which distances are those from a pixel's plane; beyond, from its point."""
_BEHIND = 8.0
"""Voxels behind a surface that count as matter; what lies farther behind it was not seen."""
_MARGIN = 1.5
"""Voxels before a surface that are not called free yet, and as many standard deviations of the depth."""


@dataclass(frozen=True, eq=False)
class _Surface:
    """What one image measured in the region. points, normals: (P, 3), world · depth: (H, W), smoothed, 0 for none ·
    margin: (H, W)."""

    frame: Frame
    points: Floats
    normals: Floats
    depth: NDArray[np.float32]
    margin: NDArray[np.float32]


def focused_field(frames: Sequence[Frame], region: OrientedBox, voxel: float | None = None) -> ObservedField:
    """Signed distances in ``region``, world frame and unit, with what the images have seen of it.

    voxel: from node to node; None: as wide as a pixel of the sharper images is at its surface.
    Raises DatasetError (DATASET_NOTHING_IN_BOUNDS) where no image measured a surface in the region.
    """
    corners = region.corners().numpy()
    low, high = corners.min(axis=0), corners.max(axis=0)
    seen = [surface for frame in frames if (surface := _measured(frame, low, high)) is not None]
    if not seen:
        raise DatasetError("no depth image shows a surface in the region", reason="DATASET_NOTHING_IN_BOUNDS")
    points, normals = (np.concatenate([getattr(one, name) for one in seen]) for name in ("points", "normals"))
    edge = voxel or _pixel_width(seen)
    edge = max(edge, float(np.prod(high - low) / _MOST_NODES) ** (1.0 / 3.0))
    shape = tuple(int(n) for n in np.ceil((high - low) / edge) + 1)
    nodes = np.stack(np.meshgrid(*(low[k] + edge * np.arange(shape[k]) for k in range(3)), indexing="ij"), axis=-1)
    free, behind = _carved(nodes.reshape(-1, 3), seen, edge)
    values = _distances(nodes, points, normals, free.reshape(shape), behind.reshape(shape), low, edge)
    observation = _observation(points, free.reshape(shape), low, edge, shape)
    origin, step = (torch.from_numpy(np.asarray(v, np.float32)) for v in (low, np.full(3, edge)))
    top = torch.from_numpy((low + edge * (np.array(shape) - 1)).astype(np.float32))
    function = BoxExtension(VoxelGridFunction(torch.from_numpy(values), origin, step, None), origin, top, 1.0)
    field = FunctionField(function, torch.from_numpy(np.stack([low, low + edge * (np.array(shape) - 1)])))
    return ObservedField(field, observation)


def _measured(frame: Frame, low: Floats, high: Floats) -> _Surface | None:
    """The pixels whose surface lies in the region; those that share a plane with too few others are left out: at edges
    sensors mix two depths."""
    planes = pixel_planes(frame.depth, frame.camera.K)
    depth = np.where(planes.known, planes.depth, 0.0)
    rows, columns = np.nonzero(depth > 0.0)
    rays = frame.camera.rays(np.stack([columns, rows], axis=1) + 0.5)
    R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    points = (rays * depth[rows, columns][:, None]) @ R.T + t
    inside = ((points >= low) & (points <= high)).all(axis=1)
    if not inside.any():
        return None
    normals = planes.normals[rows[inside], columns[inside]] @ R.T
    return _Surface(frame, points[inside], normals, depth.astype(np.float32), planes.deviations)


def _pixel_width(seen: Sequence[_Surface]) -> float:
    widths = []
    for one in seen:
        T = np.linalg.inv(one.frame.T_world_camera)
        z = one.points @ T[2, :3] + T[2, 3]
        widths.append(z / one.frame.camera.K[0, 0])
    return float(np.quantile(np.concatenate(widths), _SHARP))


def _carved(nodes: Floats, seen: Sequence[_Surface], edge: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which nodes (N, 3) an image looked through, and which lie behind what one measured, in no image before it."""
    free, behind = np.zeros(len(nodes), np.bool_), np.zeros(len(nodes), np.bool_)
    for one in seen:
        T = np.linalg.inv(one.frame.T_world_camera)
        local = nodes @ T[:3, :3].T + T[:3, 3]
        ahead = local[:, 2] > 0.0
        pixels = np.floor(one.frame.camera.project(np.where(ahead[:, None], local, 1.0))).astype(np.int64)
        height, width = one.depth.shape
        ahead &= (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        row, column = (np.where(ahead, pixels[:, k], 0) for k in (1, 0))
        measured = one.depth[row, column]
        ahead &= measured > 0.0
        gap = measured - local[:, 2]
        free |= ahead & (gap > _MARGIN * (edge + one.margin[row, column]))
        behind |= ahead & (gap < 0.0)
    return free, behind & ~free


def _distances(
    nodes: Floats,
    points: Floats,
    normals: Floats,
    free: NDArray[np.bool_],
    behind: NDArray[np.bool_],
    low: Floats,
    edge: float,
) -> NDArray[np.float32]:
    """(X, Y, Z): from the nearest voxel's mean point and plane near the surface, from the point beyond."""
    shape = free.shape
    cells = np.round((points - low) / edge).astype(np.int64)
    flat = np.ravel_multi_index(tuple(np.clip(cells, 0, np.array(shape) - 1).T), shape)
    count = np.bincount(flat, minlength=free.size)
    held = np.flatnonzero(count)

    def means(values: Floats) -> Floats:
        sums = [np.bincount(flat, values[:, axis], minlength=free.size)[held] for axis in range(3)]
        return np.stack(sums, axis=1) / count[held][:, None]

    places, planes = means(points), means(normals)
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-9)
    number = np.full(free.size, -1)
    number[held] = np.arange(len(held))
    nearest = ndimage.distance_transform_edt((count == 0).reshape(shape), return_distances=False, return_indices=True)
    index = number[np.ravel_multi_index(tuple(nearest.reshape(3, -1)), shape)]
    offset = nodes.reshape(-1, 3) - places[index]
    apart = np.linalg.norm(offset, axis=1)
    across = np.einsum("nc,nc->n", offset, planes[index])
    sign = np.where(behind.ravel() & (apart <= _BEHIND * edge), -1.0, 1.0)
    near = apart <= _PLANAR * edge
    values = np.where(near, across, sign * apart)
    return values.reshape(shape).astype(np.float32)


def _observation(
    points: Floats, free: NDArray[np.bool_], low: Floats, edge: float, shape: tuple[int, ...]
) -> Observation:
    """Voxels of two nodes' edge: free where all their nodes are, a surface where a point lies."""
    counts = tuple(max(1, -(-(n - 1) // 2)) for n in shape)
    states = np.full(counts, UNSEEN, np.uint8)
    padded = np.zeros(tuple(2 * n for n in counts), np.bool_)
    padded[tuple(slice(0, min(s, 2 * n)) for s, n in zip(shape, counts, strict=True))] = free[
        tuple(slice(0, 2 * n) for n in counts)
    ]
    blocks = padded.reshape(counts[0], 2, counts[1], 2, counts[2], 2)
    states[blocks.all(axis=(1, 3, 5))] = FREE
    cells = np.floor((points - low) / (2.0 * edge)).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < np.array(counts))).all(axis=1)]
    states[tuple(cells.T)] = SURFACE
    return Observation(torch.from_numpy(states), torch.from_numpy(low.copy()), 2.0 * edge)

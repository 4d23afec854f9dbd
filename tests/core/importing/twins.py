"""A solid whose mirror image is another solid, its exact distance, and files of it that independent writers made.

The solid is a tripod: cells of a quarter, five along x, three along y, two along z, from a common one. Its distance is
that to the rectangles which bound it, computed here and shared with nothing of the package.
"""

from __future__ import annotations

import io
import sqlite3
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import open3d
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]
CELL = 0.25
_CELLS = {(i, 0, 0) for i in range(5)} | {(0, i, 0) for i in range(3)} | {(0, 0, i) for i in range(2)}
MARKS = np.array([[1.45, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 0.65], [-0.2, 0.1, 0.1], [1.1, 0.45, 0.1]])
BY_HAND = np.array([0.2, 0.25, 0.15, 0.2, 0.2])
"""The distances at MARKS: beyond the three ends, before the corner, and beside the long arm."""


def _faces() -> tuple[Array, Array]:
    """(Q, 4, 3) the corners of the squares that bound the cells, in order around the outside, and their normals."""
    corners, normals = [], []
    for cell, axis, side in product(sorted(_CELLS), range(3), (0, 1)):
        step = np.eye(3, dtype=int)[axis] * (2 * side - 1)
        if tuple(np.add(cell, step)) in _CELLS:
            continue
        first, second = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        start = np.array(cell, float) + side * np.eye(3)[axis]
        ring = [start, start + first, start + first + second, start + second]
        corners.append(ring if side else ring[::-1])
        normals.append(step)
    return CELL * np.array(corners), np.array(normals, float)


_SQUARES, _NORMALS = _faces()
_ARMS = CELL * np.array([[5.0, 1.0, 1.0], [1.0, 3.0, 1.0], [1.0, 1.0, 2.0]])
"""The highest corners of the three; the lowest of all is the origin."""


def tripod(points: Array) -> Array:
    """(...,) signed distances at points (..., 3), positive outside."""
    flat = points.reshape(-1, 3)
    found = np.min([_apart(flat, np.zeros(3), arm) for arm in _ARMS], axis=0)
    inside = np.flatnonzero(found == 0.0)
    within = [_apart(flat[inside], square.min(axis=0), square.max(axis=0)) for square in _SQUARES]
    found[inside] = -np.min(within, axis=0)
    return np.asarray(found.reshape(points.shape[:-1]))


def _apart(points: Array, low: Array, high: Array) -> Array:
    """(N,) distances of points (N, 3) from a box, 0 within."""
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1))


@dataclass(frozen=True, eq=False)
class Twin:
    """The tripod moved by x -> scale M x + shift. M: (3, 3), of ones and zeros."""

    M: Array
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: Array) -> Array:
        """(...,) at points (..., 3) of the twin's frame."""
        return np.asarray(self.scale * tripod((points - self.shift) / self.scale @ self.M))

    def at(self, points: Array) -> Array:
        """Where points (..., 3) of the tripod are."""
        return np.asarray(self.scale * points @ self.M.T + self.shift)

    @property
    def mesh(self) -> trimesh.Trimesh:
        quads = np.arange(4 * len(_SQUARES)).reshape(-1, 4)
        turned = np.linalg.det(self.M) < 0
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        made = trimesh.Trimesh(self.at(_SQUARES.reshape(-1, 3)), faces[:, ::-1] if turned else faces, process=False)
        made.merge_vertices()
        return made

    def cloud(self, count: int = 2000) -> tuple[Array, Array]:
        """Points on the surface and their normals, evenly."""
        rng = np.random.default_rng(0)
        chosen = rng.integers(len(_SQUARES), size=count)
        u, v = rng.random((2, count, 1))
        squares = _SQUARES[chosen]
        points = squares[:, 0] + u * (squares[:, 1] - squares[:, 0]) + v * (squares[:, 3] - squares[:, 0])
        return self.at(points), _NORMALS[chosen] @ self.M.T

    def box(self, margin: float = 0.4) -> Array:
        """(2, 3): lowest and highest corner with some space around."""
        corners = self.at(_SQUARES.reshape(-1, 3))
        return np.stack([corners.min(axis=0) - margin * self.scale, corners.max(axis=0) + margin * self.scale])


PLAIN, MIRRORED = Twin(np.eye(3)), Twin(np.diag([-1.0, 1.0, 1.0]))
SWAPPED = Twin(np.eye(3)[[2, 1, 0]])
"""x and z changed places: what a grid with z first is."""
TURNED = Twin(np.eye(3)[[1, 2, 0]])
UPRIGHT = Twin(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
"""y up became z up."""
TWINS = {"plain": PLAIN, "mirrored": MIRRORED, "swapped": SWAPPED, "turned": TURNED, "upright": UPRIGHT}


# Files, each by a library or by the format's published layout.


def grid_arrays(twin: Twin, step: float = 0.05) -> dict[str, Any]:
    """A dense grid, the first axis x."""
    low, high = twin.box()
    axes = [low[i] + step * twin.scale * np.arange(round((high[i] - low[i]) / step / twin.scale) + 1) for i in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return {"sdf": twin.distance(nodes).astype(np.float32), "origin": low, "spacing": np.full(3, step * twin.scale)}


def _npz(arrays: dict[str, Any]) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _blocks(twin: Twin, size: float) -> NDArray[np.int64]:
    """(B, 3) indices of blocks of eight voxels that cover the box."""
    low, high = (np.floor(corner / (8 * size)).astype(int) for corner in twin.box())
    return np.stack(np.meshgrid(*map(np.arange, low, high + 1), indexing="ij"), axis=-1).reshape(-1, 3)


def voxel_block_arrays(twin: Twin, size: float = 0.05) -> dict[str, Any]:
    """Open3D writes the map and says itself where each voxel is."""
    size, core = size * twin.scale, open3d.core
    kinds = (core.float32, core.float32)
    made = open3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), kinds, (1, 1), size, 8, 64)
    made.hashmap().activate(core.Tensor(_blocks(twin, size).astype(np.int32)))
    buffers = made.hashmap().active_buf_indices()
    places, order = made.voxel_coordinates_and_flattened_indices(buffers)
    cut = np.clip(twin.distance(places.numpy().astype(float)) / (4 * size), -1.0, 1.0)
    made.attribute("tsdf").reshape((-1, 1))[order] = core.Tensor(cut.astype(np.float32)[:, None])
    made.attribute("weight").reshape((-1, 1))[order] = core.Tensor(np.ones((len(cut), 1), np.float32))
    with tempfile.TemporaryDirectory() as folder:
        made.save(f"{folder}/map.npz")
        return dict(np.load(f"{folder}/map.npz"))


def nvblox(
    twin: Twin,
    size: float = 0.05,
    block: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray,
    index: Callable[[tuple[int, ...]], tuple[int, ...]] = tuple,
    edge: float | None = None,
) -> bytes:
    """A map in SQLite after nvblox's published layout, x slowest. block, index: what is stored in place of a block of
    (8, 8, 8, 2) numbers and of its index · edge: of a block, as it is stored."""
    size *= twin.scale
    voxels = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1)
    rows = []
    for at in _blocks(twin, size):
        cut = np.clip(twin.distance(size * (8 * at + voxels + 0.5)), -4 * size, 4 * size)
        stored = block(np.stack([cut, np.ones_like(cut)], axis=-1).astype("<f4"))
        rows.append((*index(tuple(map(int, at))), stored.astype(stored.dtype).tobytes()))
    with tempfile.TemporaryDirectory() as folder:
        connection = sqlite3.connect(f"{folder}/map")
        connection.execute("CREATE TABLE tsdf_layer_metadata (param_name TEXT PRIMARY KEY, value_float REAL)")
        connection.execute("CREATE TABLE tsdf_layer_data (index_x INT, index_y INT, index_z INT, data BLOB)")
        connection.execute("INSERT INTO tsdf_layer_metadata VALUES ('block_size', ?)", (edge or 8 * size,))
        connection.executemany("INSERT INTO tsdf_layer_data VALUES (?, ?, ?, ?)", rows)
        connection.commit()
        connection.close()
        return Path(f"{folder}/map").read_bytes()


def _exported(kind: str) -> Callable[[Twin], bytes]:
    def write(twin: Twin) -> bytes:
        data = twin.mesh.export(file_type=kind)
        return data.encode() if isinstance(data, str) else bytes(data)

    return write


def _by_open3d(ending: str, normals: bool) -> Callable[[Twin], bytes]:
    def write(twin: Twin) -> bytes:
        points, along = twin.cloud()
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        if normals:
            cloud.normals = open3d.utility.Vector3dVector(along)
        with tempfile.TemporaryDirectory() as folder:
            assert open3d.io.write_point_cloud(f"{folder}/cloud.{ending}", cloud)
            return Path(f"{folder}/cloud.{ending}").read_bytes()

    return write


def las(twin: Twin) -> bytes:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 1e-5 * twin.scale)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = twin.cloud()[0].T
    out = io.BytesIO()
    cloud.write(out)
    return out.getvalue()


WRITERS: dict[str, Callable[[Twin], bytes]] = {
    "grid": lambda twin: _npz(grid_arrays(twin)),
    "voxel blocks": lambda twin: _npz(voxel_block_arrays(twin)),
    "nvblox": nvblox,
    **{kind: _exported(kind) for kind in ("ply", "obj", "stl", "glb")},
    "ply cloud": _by_open3d("ply", True),
    "pcd cloud": _by_open3d("pcd", True),
    "xyz cloud": _by_open3d("xyzn", True),
    "las cloud": las,
}
"""By what the file is. Names that end in cloud are of points."""

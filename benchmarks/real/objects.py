"""Objects as one half of a sequence shows them: points with normals, a dense grid, or a field fitted to its frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d
import torch

from benchmarks.real.fusion import open_fused, surface, voxel_of
from benchmarks.real.scenes import Thing
from benchmarks.real.sequence import Floats
from regnf_core.fields.observation import SdfField
from regnf_core.loading import open_field

KINDS = ("points", "grid", "fit")
_LEAST_POINTS = 100
_MOST_STEPS = 200
"""Along the longest edge of a grid that is cut out."""


def is_shown(fused: Path, thing: Thing) -> bool:
    """Whether a fused map has surface enough in the thing's box."""
    vertices = surface(fused)[0] @ thing.T_room_world.rotation.numpy().T
    return int(_within(vertices, thing).sum()) >= _LEAST_POINTS


def cut_points(fused: Path, thing: Thing, path: Path) -> None:
    """Write the fused surface's vertices in the box with their normals, room frame, as .ply."""
    vertices, normals = surface(fused)
    rotation = thing.T_room_world.rotation.numpy()
    vertices, normals = vertices @ rotation.T, normals @ rotation.T
    inside = _within(vertices, thing)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(vertices[inside]))
    cloud.normals = open3d.utility.Vector3dVector(normals[inside])
    open3d.io.write_point_cloud(path, cloud)


def _within(points: Floats, thing: Thing) -> np.typing.NDArray[np.bool_]:
    """(N,) of points (N, 3), room frame."""
    inside: np.typing.NDArray[np.bool_] = ((points > thing.low) & (points < thing.high)).all(axis=1)
    return inside


def cut_grid(fused: Path, thing: Thing, path: Path) -> None:
    """Write the fused distances in the box, room frame, as .npz with weights.

    The grid's step is half the map's voxel; large things have a coarser one.
    """
    scene = open_fused(fused)
    step = max(voxel_of(fused) / 2.0, float((thing.high - thing.low).max()) / _MOST_STEPS)
    counts = np.ceil((thing.high - thing.low) / step).astype(int) + 1
    axes = [thing.low[k] + step * np.arange(counts[k]) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    world = torch.from_numpy(nodes @ thing.T_room_world.rotation.numpy())
    values = scene.signed_distance(world.float()).numpy().reshape(counts)
    weights = seen_voxels(fused, world.numpy()).reshape(counts)
    np.savez(path, sdf=values, weight=weights, origin=thing.low, spacing=np.full(3, step))


def seen_voxels(fused: Path, points: Floats) -> np.typing.NDArray[np.float32]:
    """(N,) 1 where the voxel of a fused map nearest to each of the points (N, 3), world frame, was seen, else 0."""
    arrays = np.load(fused)
    keys, edge = arrays["key"], arrays["block_resolution"].item()
    weights = arrays[f"value_{arrays['attr_name_weight'].item():03d}"][..., 0]  # (B, R, R, R), x last
    cells = np.rint(points / arrays["voxel_size"].item()).astype(np.int64)
    low = keys.min(axis=0)
    shape = keys.max(axis=0) - low + 1
    table = np.full(shape, -1)
    table[tuple((keys - low).T)] = np.arange(len(keys))
    block = cells // edge - low
    inside = ((block >= 0) & (block < shape)).all(axis=1)
    number = np.where(inside, table[tuple(block.clip(0, shape - 1).T)], -1)
    x, y, z = (cells % edge).T
    return np.where(number >= 0, weights[number, z, y, x] > 0, False).astype(np.float32)


def open_object(path: Path) -> SdfField:
    """The field of an object that was cut out, room frame."""
    return open_field(path)

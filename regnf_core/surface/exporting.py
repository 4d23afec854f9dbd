"""Fields as files of other programs: triangle meshes and dense grids."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.ply import export_ply

from regnf_core.errors import InvalidInputError
from regnf_core.fields.base import SdfField
from regnf_core.files import atomic_path
from regnf_core.surface.isosurface import Lattice, extract_surface

MESH_FORMATS = ("glb", "ply")
_SLAB_POINTS = 1 << 18
_MAX_NODES = 1 << 28

Progress = Callable[[int], None]
"""Called with the number of points evaluated so far."""


def write_mesh(field: SdfField, path: Path, resolution: int = 128, progress: Progress | None = None) -> int:
    """The field's surface as .glb or .ply (by the suffix), own frame and unit; returns how many triangles it has.

    resolution: cells along the longest edge of the bounds. The file is written atomically. Raises NoSurfaceError and
    InvalidInputError (INVALID_OPTIONS, FIELD_NOT_FINITE).
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in MESH_FORMATS:
        raise InvalidInputError(f"no format for meshes: {path.suffix}", reason="INVALID_OPTIONS")
    surface = extract_surface(field, resolution, progress)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_normals=surface.normals, process=False)
    export: Callable[..., bytes] = partial(export_glb, include_normals=True)
    if kind == "ply":
        export = partial(export_ply, vertex_normal=True)
    data = export(mesh)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return len(surface.faces)


def write_grid(field: SdfField, path: Path, resolution: int = 128, progress: Progress | None = None) -> tuple[int, ...]:
    """The field at the nodes of a regular grid over its bounds, as .npz with the arrays sdf, origin and spacing.

    sdf (X, Y, Z) float32, first axis x; node (i, j, k) is at origin (3,) + spacing (3,) * (i, j, k); see
    docs/families.md. Returns sdf's shape. Raises InvalidInputError (INVALID_OPTIONS, FIELD_NOT_FINITE).
    """
    lattice = Lattice.over(field, resolution)
    shape = tuple(int(n) for n in lattice.counts)
    if np.prod(shape) > _MAX_NODES:
        raise InvalidInputError(f"a grid of {shape} nodes has more than {_MAX_NODES}", reason="INVALID_OPTIONS")
    values = np.empty(shape, np.float32)
    slab = max(1, _SLAB_POINTS // (shape[1] * shape[2]))
    for start in range(0, shape[0], slab):
        rows = np.arange(start, min(start + slab, shape[0]))
        nodes = np.stack(np.meshgrid(rows, *map(np.arange, shape[1:]), indexing="ij"), axis=-1).reshape(-1, 3)
        distance = field.signed_distance(torch.from_numpy(lattice.points_of(nodes)).float())
        values[rows] = distance.cpu().numpy().reshape(len(rows), *shape[1:])
        if progress is not None:
            progress(values[: rows[-1] + 1].size)
    if not np.isfinite(values).all():
        raise InvalidInputError("the field gives values that are not finite", reason="FIELD_NOT_FINITE")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, sdf=values, origin=lattice.low, spacing=np.full(3, lattice.step))
    return shape

"""Fields as files of other programs: triangle meshes and dense grids."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
import trimesh
from trimesh.exchange.gltf import export_glb

from regnf_core.errors import InvalidInputError, atomic_path
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import SdfField
from regnf_core.surface.isosurface import Floats, Lattice, Progress, Surface, extract_surface

MESH_FORMATS = ("glb", "ply")
_SLAB_POINTS = 1 << 18
_MAX_NODES = 1 << 28


def write_mesh(field: SdfField, path: Path, resolution: int = 128, progress: Progress | None = None) -> int:
    """The field's surface as .glb or .ply (by the suffix), own frame and unit; returns how many triangles it has.

    resolution: cells along the longest edge of the bounds. The file is written atomically. Raises NoSurfaceError and
    InvalidInputError (INVALID_OPTIONS, FIELD_NOT_FINITE).
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in MESH_FORMATS:
        raise InvalidInputError(f"not a format for meshes: {path.suffix}", reason="INVALID_OPTIONS")
    field, origin = near_origin(field)
    surface = extract_surface(field, resolution, progress)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_normals=surface.normals, process=False)
    data = glb_of(mesh, origin.numpy()) if kind == "glb" else _ply_of(surface, origin.numpy())
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return len(surface.faces)


def glb_of(mesh: trimesh.Trimesh, origin: Floats, normals: bool = True) -> bytes:
    """The mesh as .glb, ``origin`` (3,) added to its places by its node: vertices have single precision alone."""
    shift = np.eye(4)
    shift[:3, 3] = origin
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=shift)
    export: Callable[..., bytes] = partial(export_glb, include_normals=normals)
    return export(scene)


def _ply_of(surface: Surface, origin: Floats) -> bytes:
    """The surface as .ply, in double precision where it lies far from the origin."""
    places = "<f8" if origin.any() else "<f4"
    names = ("x", "y", "z", "nx", "ny", "nz")
    vertices = np.empty(len(surface.vertices), [(name, places if len(name) == 1 else "<f4") for name in names])
    for name, values in zip(names, np.hstack([surface.vertices + origin, surface.normals]).T, strict=True):
        vertices[name] = values
    faces = np.empty(len(surface.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, surface.faces
    words = {"<f8": "double", "<f4": "float"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property {words[places if len(name) == 1 else '<f4']} {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


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
        distance = field.signed_distance(torch.from_numpy(lattice.points_of(nodes)))
        values[rows] = distance.cpu().numpy().reshape(len(rows), *shape[1:])
        if progress is not None:
            progress(values[: rows[-1] + 1].size)
    if not np.isfinite(values).all():
        raise InvalidInputError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, sdf=values, origin=lattice.low, spacing=np.full(3, lattice.step))
    return shape

"""The surface of a field as a mesh with a color at each vertex."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh

from regnf_core.fields.base import SdfField
from regnf_core.fields.transformed import near_origin
from regnf_core.files import atomic_path
from regnf_core.rendering.options import RenderOptions
from regnf_core.rendering.shading import Painter
from regnf_core.surface.exporting import glb_of
from regnf_core.surface.isosurface import extract_surface

_AT_ONCE = 1 << 16


def write_colored_mesh(
    field: SdfField,
    path: Path,
    resolution: int,
    options: RenderOptions,
    progress: Callable[[int], None] | None = None,
) -> int:
    """The zero level as .glb, in the field's frame and unit; returns how many triangles it has.

    A vertex has its part's own color, seen from before the surface, or its tint, or one plain color: no shading.
    Raises NoSurfaceError and InvalidInputError (FIELD_NOT_FINITE, COLORS_MISSING).
    """
    field, origin = near_origin(field)
    surface = extract_surface(field, resolution, progress)
    painter = Painter.of(field, torch.tensor([0.0, 0.0, 1.0]), options)
    points, normals = (torch.from_numpy(part).float() for part in (surface.vertices, surface.normals))
    parts = zip(torch.split(points, _AT_ONCE), torch.split(normals, _AT_ONCE), strict=True)
    colors = torch.cat([painter.flat_colors(p.to(field.device), -n.to(field.device)).cpu() for p, n in parts])
    levels = (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    shown = np.concatenate([levels, np.full((len(levels), 1), 255, np.uint8)], axis=1)
    mesh = trimesh.Trimesh(
        surface.vertices, surface.faces, vertex_normals=surface.normals, vertex_colors=shown, process=False
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(glb_of(mesh, origin.numpy()))
    return len(surface.faces)

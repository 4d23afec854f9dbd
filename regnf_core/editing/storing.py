"""An edited scene as a field file, for registrations and renderings of another day."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from regnf_core.errors import InvalidInputError
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import ColoredField, SdfField, has_color, observation_of
from regnf_core.schema.description import COLOR, OBSERVATION, VALUES, ValueColor, color_tensors
from regnf_core.schema.safe_format import write_safe_field
from regnf_core.schema.similarity import moved_box, shift_rows
from regnf_core.surface.isosurface import Lattice

_SLAB_POINTS = 1 << 18
_MOST_NODES = 1 << 27
_COLORED_CELLS = 3.0
"""Nodes no farther from the surface, in cells, have a color: more than a point of the surface lies between."""
_UNKNOWN = -1.0


def write_field(field: SdfField, path: Path, resolution: int) -> tuple[int, int, int]:
    """Write ``field`` as a dense grid in the safe format, with the observation and colors that it has; the node counts.

    resolution: cells along the longest edge of the bounds. Details finer than a cell are lost; colors are those seen
    from straight before the surface.
    Raises InvalidInputError (INVALID_OPTIONS, FIELD_NOT_FINITE).
    """
    field, origin = near_origin(field)
    lattice = Lattice.over(field, resolution)
    x, y, z = (int(n) for n in lattice.counts)
    if x * y * z > _MOST_NODES:
        raise InvalidInputError(f"a grid of {x} x {y} x {z} nodes is too large", reason="INVALID_OPTIONS")
    values = np.empty((x, y, z), np.float32)
    colors = np.full((x, y, z, 3), _UNKNOWN, np.float16) if has_color(field) else None
    slab = max(1, _SLAB_POINTS // (y * z))
    for start in range(0, x, slab):
        rows = np.arange(start, min(start + slab, x))
        nodes = np.stack(np.meshgrid(rows, np.arange(y), np.arange(z), indexing="ij"), axis=-1).reshape(-1, 3)
        points = torch.from_numpy(lattice.points_of(nodes)).float()
        distance = field.signed_distance(points).cpu()
        values[rows] = distance.numpy().reshape(len(rows), y, z)
        if has_color(field) and colors is not None:
            near = distance.abs() <= _COLORED_CELLS * lattice.step
            colors[rows] = _colors(field, points, near).reshape(len(rows), y, z, 3)
    if not np.isfinite(values).all():
        raise InvalidInputError("the field evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")
    bounds = [lattice.low.tolist(), (lattice.low + lattice.step * (lattice.counts - 1)).tolist()]
    description: dict[str, Any] = {
        "kind": "voxel_grid", "origin": bounds[0], "spacing": [lattice.step] * 3, "bounds": bounds
    }  # fmt: skip
    if origin.any():
        placed = shift_rows(origin.tolist())
        description |= {"placement": {"transform": placed, "bounds": bounds}, "bounds": moved_box(placed, bounds)}
    tensors: dict[str, Any] = {"values": values}
    known = observation_of(field)
    if known is not None and (known := known.without_shift()).T_grid_frame is None:
        grid, tensors[OBSERVATION] = known.stored()
        description[OBSERVATION] = {"low": list(grid.low), "voxel": grid.voxel, "counts": list(grid.counts)}
    if colors is not None:
        description[COLOR] = asdict(ValueColor("values"))
        tensors |= color_tensors({VALUES: colors})
    write_safe_field(path, description, tensors)
    return x, y, z


def _colors(field: ColoredField, points: Tensor, chosen: Tensor) -> NDArray[np.float16]:
    """(N, 3) of points (N, 3): that of the surface before each of the ``chosen`` (N,); -1 elsewhere."""
    colors = np.full((len(points), 3), _UNKNOWN, np.float16)
    places = points[chosen]
    if len(places):
        distance, gradient = (value.to(places) for value in field.signed_distance_and_gradient(places))
        inward = -torch.nn.functional.normalize(gradient, dim=-1)
        found = field.color(places + distance[:, None] * inward, inward)
        colors[chosen.numpy()] = found.cpu().clamp(0.0, 1.0).half().numpy()
    return colors

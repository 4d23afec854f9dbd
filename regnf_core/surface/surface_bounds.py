"""The bounding box of an object's surface: the bounds of a field are often much larger than the object."""

from __future__ import annotations

import torch

from regnf_core.errors import NoSurfaceError
from regnf_core.fields.base import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.surface.projection import newton_step
from regnf_core.surface.sphere_tracing import finite_distance

_GRID = 32  # cells along the longest edge; 32,768 evaluations at most
_MARGIN = 0.02


def surface_bounds(field: SdfField) -> OrientedBox:
    """The axis-aligned box of the field's zero level, field frame.

    Evaluates a grid of cell centers. One Newton step projects the centers of cells that may hold surface onto it.
    Raises NoSurfaceError (NO_SURFACE_IN_OBJECT) when no cell does, InvalidInputError (FIELD_NOT_FINITE).
    """
    low, high = field.bounds
    cell = float((high - low).max()) / _GRID
    counts = ((high - low) / cell).ceil().clamp_min(1).long().tolist()
    axes = [
        low[k] + (torch.arange(count, dtype=torch.float64) + 0.5) * (high[k] - low[k]) / count
        for k, count in enumerate(counts)
    ]
    centers = torch.cartesian_prod(*axes).to(field.device)
    near = finite_distance(field, centers).abs() <= 0.5 * 3**0.5 * cell
    if not near.any():
        raise NoSurfaceError("the object's field has no surface within its bounds", reason="NO_SURFACE_IN_OBJECT")
    distance, gradient = field.signed_distance_and_gradient(centers[near])
    surface = (centers[near] - newton_step(distance, gradient).to(centers)).double().cpu()
    lowest, highest = torch.maximum(surface.amin(0), low), torch.minimum(surface.amax(0), high)
    center, size = (lowest + highest) / 2, (highest - lowest).clamp_min(cell)
    return OrientedBox(center, size * (1.0 + _MARGIN), torch.eye(3, dtype=torch.float64))

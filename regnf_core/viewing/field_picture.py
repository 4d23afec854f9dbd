"""A picture of a field alone: its surface from two sides, and a section that shows its distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image

from regnf_core.fields.observation import SdfField
from regnf_core.surface.isosurface import Lattice, Progress, Surface, extract_surface
from regnf_core.viewing.splats import Floats, Surfels, render, view_from


@dataclass(frozen=True)
class Size:
    """panel: pixels of each panel's edge · resolution: cells along the bounds' longest edge."""

    panel: int
    resolution: int


PANEL = 320
USUAL, SMALL = Size(PANEL, 72), Size(192, 48)
_OVERSAMPLING = 2
_COLOR = np.array([0.72, 0.75, 0.79])
_BACKGROUND = np.array([0.975, 0.975, 0.97])
_SIDES = ((1.0, 0.55, 0.6), (-0.7, -1.0, 0.6))
"""Directions towards the viewer: along the first and the second horizontal axis, and up."""
_DISC = 0.95
"""Radius of the discs in lattice steps: they overlap a little."""
_INSIDE, _OUTSIDE = np.array([0.93, 0.62, 0.35]), np.array([0.45, 0.62, 0.80])
_LINES = 20.0
"""Isolines to a diagonal."""


def field_picture(
    field: SdfField, up_axis: str | None = None, size: Size = USUAL, progress: Progress | None = None
) -> Image.Image:
    """Three square panels side by side: two views from above, and the plane through the middle of the surface.

    The plane is across the surface's shortest extent. Orange is inside and blue is free, lighter with distance; lines
    are a twentieth of the bounds' diagonal apart. up_axis: "z" if not given. Takes some 250,000 evaluations
    of the usual size; ``progress`` hears of them.
    Raises NoSurfaceError where there is none, and InvalidInputError (FIELD_NOT_FINITE).
    """
    surface = extract_surface(field, size.resolution, progress)
    radius = _DISC * Lattice.over(field, size.resolution).step
    axis = "xyz".index((up_axis or "z")[-1])
    up = np.eye(3)[axis] * (-1.0 if (up_axis or "z").startswith("-") else 1.0)
    first, pixels = np.eye(3)[(axis + 1) % 3], size.panel * _OVERSAMPLING
    surfels = Surfels(surface.vertices, surface.normals, np.broadcast_to(_COLOR, surface.vertices.shape))
    panels = []
    for along, across, above in _SIDES:
        view = view_from(along * first + across * np.cross(up, first) + above * up, up, surface.vertices, pixels)
        picture = _image(render(surfels, view, pixels, radius, _BACKGROUND))
        panels.append(picture.resize((size.panel, size.panel), Image.Resampling.LANCZOS))
    sheet = Image.new("RGB", (3 * size.panel, size.panel))
    for number, panel in enumerate([*panels, _section(field, surface, size.panel)]):
        sheet.paste(panel, (number * size.panel, 0))
    return sheet


def _section(field: SdfField, surface: Surface, pixels: int) -> Image.Image:
    low, high = field.bounds.numpy()
    across = int(np.ptp(surface.vertices, axis=0).argmin())
    right, up = [(1, 2), (0, 2), (0, 1)][across]
    edge = 1.05 * max(high[right] - low[right], high[up] - low[up])
    pixel = edge / pixels
    aside = (np.arange(pixels) + 0.5) * pixel - edge / 2
    places = np.empty((pixels, pixels, 3))
    places[...] = (low + high) / 2
    places[..., right] += aside
    places[..., up] -= aside[:, None]
    places[..., across] = np.median(surface.vertices[:, across])
    within = ((places >= low) & (places <= high)).all(axis=-1)
    distance = np.zeros((pixels, pixels))
    distance[within] = field.signed_distance(torch.from_numpy(places[within])).double().cpu().numpy()
    picture = np.broadcast_to(_BACKGROUND, (pixels, pixels, 3)).copy()
    diagonal = float(np.linalg.norm(high - low))
    picture[within] = _shades(distance[within] / diagonal, pixel / diagonal)
    return _image(picture)


def _shades(distance: Floats, pixel: float) -> Floats:
    """(N, 3) colors of distances (N,) in diagonals: the surface dark, isolines faint; a line is two pixels wide."""
    fade = np.clip(np.abs(distance) / 0.35, 0.0, 1.0)[:, None] * 0.75
    base = np.where(distance[:, None] < 0, _INSIDE, _OUTSIDE)
    colors = base * (1.0 - fade) + fade
    from_line = np.abs(distance * _LINES - np.round(distance * _LINES)) / _LINES
    colors = np.where((from_line < 0.7 * pixel)[:, None], 0.82 * colors, colors)
    return np.where((np.abs(distance) < pixel)[:, None], np.array([0.15, 0.17, 0.20]), colors)


def _image(picture: Floats) -> Image.Image:
    levels = np.clip(picture, 0.0, 1.0)
    levels *= 255.0  # in place: the import's memory has its peak here
    return Image.fromarray(np.rint(levels, out=levels).astype(np.uint8))

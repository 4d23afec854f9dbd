"""overlay.png: the object's edges, at the pose that was found, on the image that its detection was made in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageDraw, ImageFilter, ImageFont
from scipy import ndimage

from regnf_core.document import RegistrationResult, sure_in_words
from regnf_core.fields.composite import near_origin
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import SdfField
from regnf_core.surface.isosurface import extract_surface
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR
from regnf_data.recordings.recording import Frame

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Mesh = tuple[Floats, NDArray[Any]]

_HEIGHT, _WIDEST, _CAPTION = 540, 960, 52
_BACKGROUND, _INK, _GRAY = (249, 249, 247), (52, 56, 62), (120, 124, 130)
_RESOLUTION = 96
_AROUND = 0.25
"""Of the object's longer side in the image, on each side of it in the close-up."""
_SMALLEST = 40.0
"""Pixels of the image that a close-up shows at least, along its side."""
_CREASE = 1.2
"""Change of the depth's slope that is an edge, in pixels' widths a pixel."""
_HIDDEN = 0.04, 0.01
"""A measured depth hides the object where it is nearer by these shares of the diameter and of the depth."""
_MOST_ALTERNATIVES = 4
_MOST_SAMPLES = 1 << 23
_HALO, _WEAK = 0.7, 0.35
"""Strengths: of the dark rim of the outline, and of lines that are hidden."""
_SMOOTH = 1.5
"""Pixels: of the depths that a picture is shaded by."""


@dataclass(frozen=True)
class _Panel:
    """A part of the image, enlarged. corner: (2,) its left and top, of the image's pixels · zoom · size: height and
    width, pixels of the panel."""

    corner: Floats
    zoom: float
    size: tuple[int, int]


def object_mesh(field: SdfField) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3), the object's own frame and unit, and triangles (F, 3) of its surface.

    Raises NoSurfaceError and InvalidInputError (FIELD_NOT_FINITE).
    """
    if isinstance(field, MeshField):
        return field.vertices, field.faces
    field, origin = near_origin(field)
    surface = extract_surface(field, _RESOLUTION)
    return surface.vertices + origin.numpy(), surface.faces


def overlay_picture(result: RegistrationResult, frame: Frame, vertices: Floats, faces: NDArray[Any]) -> Image.Image:
    """The whole image, and the object close up. Orange: the pose; blue: the other poses of an ambiguous result.

    Lines are weaker where something measured lies before the object. frame: of ``result.camera`` · vertices (V, 3),
    faces (F, 3): the object's own frame and unit. The picture is at most 1,560 pixels wide, and 592 high.
    """
    assert result.camera is not None
    frame = frame.without_lens()
    to_camera = result.camera.T_world_camera.inverse()
    poses = [to_camera @ one.T_scene_object for one in (result, *result.alternatives[:_MOST_ALTERNATIVES])]
    used = vertices[np.unique(faces)]
    diameter = float(np.linalg.norm(np.ptp(used, axis=0))) * float(poses[0].scale)
    placed = [vertices @ pose.matrix().numpy()[:3, :3].T + pose.matrix().numpy()[:3, 3] for pose in poses]
    image = shaded(frame) if frame.color is None else frame.color
    panels = _panels(frame, image.shape[:2], placed[0])
    sheet = Image.new("RGB", (sum(panel.size[1] for panel in panels), _HEIGHT + _CAPTION), _BACKGROUND)
    left = 0
    for panel in panels:
        height, width = panel.size
        low, high = panel.corner, panel.corner + np.array([width, height]) / panel.zoom
        box = (*np.maximum(low, 0.0), *np.minimum(high, image.shape[1::-1]))
        shown = Image.fromarray(image).resize((width, height), Image.Resampling.BICUBIC, box=box)
        for points, color in [*((each, SCENE_COLOR) for each in placed[1:]), (placed[0], OBJECT_COLOR)]:
            shown = _with_lines(shown, frame, panel, (points, faces), color, diameter)
        sheet.paste(shown, (left, _CAPTION))
        left += width
    away = float(np.linalg.norm(poses[0].apply(result.center_object[None])[0]))
    place = f"{away:.3f} m from the camera" + ("" if len(panels) > 1 else ", outside the image")
    _caption(sheet, result, place, len(poses) - 1)
    return sheet


def shaded(frame: Frame) -> NDArray[np.uint8]:
    """(H, W, 3): the depth image of a frame as if lit from the camera, far places darker; black: nothing measured."""
    depth = frame.depth.astype(np.float64)
    measured = depth > 0.0
    if not measured.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = np.quantile(depth[measured], (0.02, 0.98))
    slope = (
        np.hypot(*np.gradient(ndimage.gaussian_filter(depth, _SMOOTH))) / np.maximum(depth, 1e-9) * frame.camera.K[0, 0]
    )
    light = 0.35 + 0.65 / np.hypot(1.0, slope)
    light *= 1.0 - 0.6 * np.clip((depth - near) / max(far - near, 1e-9), 0.0, 1.0)
    return np.repeat((235.0 * light * measured).astype(np.uint8)[..., None], 3, axis=2)


def _panels(frame: Frame, shape: tuple[int, ...], points: Floats) -> list[_Panel]:
    """The whole image, and what is around the object, if some of it is in the image."""
    height, width = shape[:2]
    zoom = min(_HEIGHT / height, _WIDEST / width)
    panels = [_Panel(np.zeros(2), zoom, (round(height * zoom), round(width * zoom)))]
    camera = frame.color_camera or frame.camera
    before = points[points[:, 2] > 0.0]
    if not len(before):
        return panels
    pixels = camera.project(before)
    low, high = np.clip(pixels.min(0), 0.0, (width, height)), np.clip(pixels.max(0), 0.0, (width, height))
    if (high - low).min() < 1.0:
        return panels
    side = min(max(float((high - low).max()) * (1.0 + 2.0 * _AROUND), _SMALLEST), min(height, width))
    corner = np.clip((low + high - side) / 2.0, 0.0, np.array([width, height]) - side)
    return [*panels, _Panel(corner, _HEIGHT / side, (_HEIGHT, _HEIGHT))]


def _with_lines(
    shown: Image.Image, frame: Frame, panel: _Panel, mesh: Mesh, color: tuple[float, float, float], diameter: float
) -> Image.Image:
    """The panel with the edges of a mesh, camera frame."""
    camera = frame.color_camera or frame.camera
    K = np.diag([panel.zoom, panel.zoom, 1.0]) @ camera.K
    K[:2, 2] -= panel.zoom * panel.corner
    inverse = inverse_depths(*mesh, K, panel.size)
    inside = inverse > 0.0
    outline, inner = _edges(inverse, inside, float(K[0, 0]))
    rows, columns = np.nonzero(outline | inner)
    at = np.stack([columns + 0.5, rows + 0.5], axis=1) / panel.zoom + panel.corner
    found = np.floor(frame.camera.project(camera.rays(at))).astype(np.int64)
    found = np.clip(found, 0, np.array(frame.depth.shape[::-1]) - 1)
    measured, own = frame.depth[found[:, 1], found[:, 0]], 1.0 / inverse[rows, columns]
    hidden = (measured > 0.0) & (measured < own - np.maximum(_HIDDEN[0] * diameter, _HIDDEN[1] * own))
    strength = np.zeros(panel.size, np.uint8)
    strength[rows, columns] = np.where(hidden, int(255 * _WEAK), 255)
    thick = Image.fromarray(strength * outline).filter(ImageFilter.MaxFilter(3))
    rim = thick.filter(ImageFilter.MaxFilter(3)).filter(ImageFilter.GaussianBlur(0.8)).point(lambda one: one * _HALO)
    shown.paste(_INK, (0, 0), rim)
    lines = ImageChops.lighter(thick.filter(ImageFilter.GaussianBlur(0.6)), Image.fromarray(strength * inner))
    shown.paste(tuple(int(255 * part) for part in color), (0, 0), lines)
    return shown


def _edges(inverse: Floats, inside: Mask, focal: float) -> tuple[Mask, Mask]:
    """Pixels of the outline, and those within it where the depth jumps or its slope changes.

    Along a plane the inverse depth is linear in the image, so its second differences show edges alone.
    """
    padded = np.pad(inside, 1, mode="edge")
    surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    outline = inside & ~surrounded
    bent = np.zeros_like(inverse)
    bent[1:-1] = np.abs(inverse[2:] - 2.0 * inverse[1:-1] + inverse[:-2])
    bent[:, 1:-1] = np.maximum(bent[:, 1:-1], np.abs(inverse[:, 2:] - 2.0 * inverse[:, 1:-1] + inverse[:, :-2]))
    within = surrounded & ~np.asarray(Image.fromarray(outline).filter(ImageFilter.MaxFilter(5)))
    return outline, within & (bent * focal > _CREASE * inverse)


def inverse_depths(points: Floats, faces: NDArray[Any], K: Floats, size: tuple[int, int]) -> Floats:
    """(H, W): the inverse of the nearest depth of triangles at pixels' centers, 0 without one.

    points: (V, 3), camera frame · faces: (F, 3). Triangles that reach behind the camera are left out.
    """
    height, width = size
    buffer = np.zeros(height * width)
    before = points[:, 2] > 1e-6
    faces = faces[before[faces].all(axis=1)]
    inverse = 1.0 / np.where(before, points[:, 2], 1.0)
    pixels = points[:, :2] * inverse[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    share, x, y = inverse[faces], pixels[:, 0][faces], pixels[:, 1][faces]
    left, right = _covered(x, width)
    top, bottom = _covered(y, height)
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    across = right - left
    counts = np.where(area != 0.0, across * (bottom - top), 0)
    taken = np.flatnonzero(counts)
    for part in np.array_split(taken, int(counts.sum()) // _MOST_SAMPLES + 1):
        which = np.repeat(part, counts[part])
        number = np.arange(len(which)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
        row, column = top[which] + number // across[which], left[which] + number % across[which]
        px, py = column + 0.5, row + 0.5
        weights = []
        for first, second in ((1, 2), (2, 0)):
            ax, ay, bx, by = x[which, first], y[which, first], x[which, second], y[which, second]
            weights.append(((bx - ax) * (py - ay) - (by - ay) * (px - ax)) / area[which])
        weights.append(1.0 - weights[0] - weights[1])
        hit = np.minimum(np.minimum(weights[0], weights[1]), weights[2]) >= -1e-9
        value = sum(weight * share[which, corner] for corner, weight in enumerate(weights))
        np.maximum.at(buffer, (row * width + column)[hit], value[hit])
    return buffer.reshape(height, width)


def _covered(places: Floats, most: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first pixel of the image whose center lies within each triangle's extent, and the one after the last."""
    first = np.clip(np.ceil(places.min(axis=1) - 0.5), 0, most).astype(np.int64)
    last = np.clip(np.floor(places.max(axis=1) - 0.5) + 1.0, 0, most).astype(np.int64)
    return first, np.maximum(last, first)


def _caption(sheet: Image.Image, result: RegistrationResult, place: str, others: int) -> None:
    draw = ImageDraw.Draw(sheet)
    assert result.camera is not None
    heading = result.verdict.capitalize() + sure_in_words(result.probability, result.level)
    note = f"{result.camera.frame}: the object is {place}"
    if others:
        note += f"; blue: {others} other pose{'s' if others > 1 else ''}"
    draw.text((24, 10), heading, fill=_INK, font=ImageFont.load_default(size=20))
    draw.text((24, 34), note, fill=_GRAY, font=ImageFont.load_default(size=14))

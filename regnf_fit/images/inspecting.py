"""What a recording is, as its files and its images say it, and a picture of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageOps

from regnf_core.errors import DatasetError
from regnf_core.viewing.registration_picture import OBJECT_COLOR, SCENE_COLOR
from regnf_data.agreement import check_agreement
from regnf_data.recordings.choosing import choose_frames
from regnf_data.recordings.recording import Frame, Given, Recording
from regnf_fit.images.overlay import shaded

Floats = NDArray[np.float64]

_LOOKED_AT = 24
"""Frames that the report is about; those that add most."""
_SHOWN, _HEIGHT, _WIDTH = 2, 360, 480
"""Frames of a row of images alone, twice as many above their depths; and the room of one, pixels."""
_POINTS = 40_000
_ACROSS, _ALIKE = 80, 0.97
"""Pixels of an image across that its surfaces' directions are told by; the cosine between directions that are one."""
_BACKGROUND = (249, 249, 247)


@dataclass(frozen=True, eq=False)
class InspectedRecording:
    """report: plain values, the recording's unit and pixels · picture: some images, and the points from above with the
    cameras' path."""

    report: dict[str, Any]
    picture: Image.Image


def inspect_recording(recording: Recording, said: Given | None = None) -> InspectedRecording:
    """What ``recording``, opened with ``said``, is.

    Raises DatasetError where a frame that is looked at cannot be read, or none has a depth.
    """
    chosen = choose_frames(recording, _LOOKED_AT)
    frames = [recording.frames[index].read() for index in chosen.indices]
    stored = recording.frames[chosen.indices[0]]
    camera, places = frames[0].camera, np.stack([one.T_world_camera[:3, 3] for one in recording.frames])
    depths = np.concatenate([one.depth[one.depth > 0.0] for one in frames])
    height, width = frames[0].depth.shape
    colors = {one.color.shape[1::-1] for one in frames if one.color is not None}
    step, guessed = _step(frames[0].depth), any("unit" in note for note in recording.notes)
    known = "what was said" if said and said.depth_unit else "a guess" if guessed else "the recording"
    report = {
        "kind": "recording",
        "layout": recording.layout,
        "frames": len(recording),
        "unit": "meters" if recording.is_metric else "the recording's own",
        "depth_images": f"{width} x {height}",
        "color_images": " and ".join(f"{w} x {h}" for w, h in sorted(colors)) or None,
        "depth_step": step,
        "depth_step_from": None if step is None else known,
        "depth": {
            name: _rounded(float(np.quantile(depths, share)))
            for name, share in (("nearest", 0.01), ("median", 0.5), ("farthest", 0.99))
        },
        "measured_share": _rounded(float(np.mean([(one.depth > 0.0).mean() for one in frames]))),
        "camera": {
            "focal_px": [_rounded(camera.K[0, 0]), _rounded(camera.K[1, 1])],
            "middle_px": [_rounded(camera.K[0, 2]), _rounded(camera.K[1, 2])],
            "field_of_view_deg": [
                round(math.degrees(2.0 * math.atan(side / (2.0 * focal))), 1)
                for side, focal in ((width, camera.K[0, 0]), (height, camera.K[1, 1]))
            ],
            "lens": "none" if stored.camera.lens == "none" else f"{stored.camera.lens}, taken out of the images",
        },
        "bounds": [[_rounded(value) for value in row] for row in chosen.bounds.tolist()],
        "path": _rounded(float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())),
        "agreement": _agreement(recording, chosen.indices, chosen.bounds),
        "notes": list(recording.notes),
    }
    return InspectedRecording(report, _picture(frames, places))


def _step(depth: NDArray[np.float32]) -> float | None:
    """What depths are whole multiples of, as the unit of images of whole numbers; None for numbers with a point."""
    steps = np.diff(np.unique(depth[depth > 0.0].astype(np.float64)))
    if not len(steps):
        return None
    counts = steps / steps.min()
    whole = np.abs(counts - np.round(counts)) < 0.05
    return float(f"{steps.sum() / np.round(counts).sum():.3g}") if whole.mean() > 0.9 else None


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _agreement(recording: Recording, indices: tuple[int, ...], bounds: Floats) -> str:
    """How the depths of one surface agree from frame to frame, in words."""
    if len(indices) < 2:
        return "one frame: nothing to compare"
    try:
        return check_agreement(recording.posed_images(indices, bounds)) or "frames that see the same place agree"
    except DatasetError as error:
        return f"{error.reason}: {error}. {error.hint or ''}".strip()


def _picture(frames: list[Frame], places: Floats) -> Image.Image:
    """Color above depth of some frames, and beside them the points from above."""
    rows = 1 if all(one.color is None for one in frames) else 2
    picked = [frames[at] for at in np.unique(np.linspace(0, len(frames) - 1, _SHOWN * rows).astype(int))]
    height, width = _HEIGHT // rows, _WIDTH // rows
    sheet = Image.new("RGB", (width * len(picked) + _HEIGHT, _HEIGHT), _BACKGROUND)
    for number, frame in enumerate(picked):
        for row, image in enumerate((frame.color, shaded(frame))[-rows:]):
            if image is not None:
                shown = ImageOps.contain(Image.fromarray(image), (width, height))
                at = number * width + (width - shown.width) // 2, row * height + (height - shown.height) // 2
                sheet.paste(shown, at)
    sheet.paste(_from_above(frames, places, _HEIGHT), (width * len(picked), 0))
    return sheet


def _down(frames: list[Frame]) -> Floats:
    """(3,): the direction, within 60 degrees of the images' own down, that most of the surface lies across."""
    own = np.mean([one.T_world_camera[:3, 1] for one in frames], axis=0)
    own /= max(float(np.linalg.norm(own)), 1e-9)
    found = []
    for frame in frames:
        stride = max(1, frame.depth.shape[1] // _ACROSS)
        depth = frame.depth[::stride, ::stride]
        rows, columns = np.indices(depth.shape) * stride + 0.5
        rays = frame.camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1)).reshape(*depth.shape, 3)
        places = rays * depth[..., None]
        normals = np.cross(places[1:, :-1] - places[:-1, :-1], places[:-1, 1:] - places[:-1, :-1])
        known = (depth[1:, :-1] > 0.0) & (depth[:-1, 1:] > 0.0) & (depth[:-1, :-1] > 0.0)
        found.append(normals[known] @ frame.T_world_camera[:3, :3].T)
    normals = np.concatenate(found)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals *= np.sign(normals @ own)[:, None]
    normals = normals[normals @ own > 0.5]
    if not len(normals):
        return np.asarray(own)
    tried = normals[:: len(normals) // 300 + 1]
    best = tried[int((tried @ normals.T > _ALIKE).sum(axis=1).argmax())]
    down = normals[normals @ best > _ALIKE].sum(axis=0)
    found_down: Floats = down / float(np.linalg.norm(down))
    return found_down


def _from_above(frames: list[Frame], places: Floats, edge: int) -> Image.Image:
    """The points below the highest camera, by their colors; the cameras' path, from the orange end to the blue one."""
    down = _down(frames)
    across = np.cross(np.eye(3)[np.abs(down).argmin()], down)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    axes = np.stack([across, np.cross(down, across), down], axis=1)
    rng, points, colors = np.random.default_rng(0), [], []
    for frame in frames:
        found, measured = frame.points()
        taken = rng.integers(len(found), size=_POINTS // len(frames)) if len(found) else np.zeros(0, np.int64)
        image = shaded(frame) if frame.color is None else frame.registered(frame.color)
        points.append(found[taken] @ axes)
        colors.append(image[measured][taken])
    cloud, paint, path = np.concatenate(points), np.concatenate(colors), places @ axes
    below = cloud[:, 2] > path[:, 2].min()
    cloud, paint = (cloud[below], paint[below]) if below.any() else (cloud, paint)
    low, high = np.quantile(cloud, 0.01, axis=0), np.quantile(cloud, 0.99, axis=0)
    low, high = np.minimum(low, path.min(0)), np.maximum(high, path.max(0))
    scale = 0.92 * edge / max(float((high - low)[:2].max()), 1e-9)
    order = np.argsort(-cloud[:, 2])
    pixels = ((cloud[order, :2] - (low + high)[:2] / 2.0) * scale + edge / 2.0).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < edge - 1)).all(axis=1)
    image = np.full((edge, edge, 3), _BACKGROUND, np.uint8)
    for down_by, right_by in ((0, 0), (0, 1), (1, 0), (1, 1)):
        image[pixels[inside, 1] + down_by, pixels[inside, 0] + right_by] = paint[order][inside]
    shown = Image.fromarray(image)
    draw = ImageDraw.Draw(shown)
    line = [tuple(at) for at in ((path[:, :2] - (low + high)[:2] / 2.0) * scale + edge / 2.0).tolist()]
    orange, blue = (tuple(int(255 * part) for part in color) for color in (OBJECT_COLOR, SCENE_COLOR))
    draw.line(line, fill=orange, width=2)
    for at, color in ((line[-1], blue), (line[0], orange)):
        draw.ellipse((at[0] - 4, at[1] - 4, at[0] + 4, at[1] + 4), fill=color)
    return shown

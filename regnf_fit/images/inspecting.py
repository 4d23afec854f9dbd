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
from regnf_core.viewing.splats import Surfels, render, view_from
from regnf_data.recordings.choosing import choose_frames
from regnf_data.recordings.recording import Frame, Given, Recording, check_recording
from regnf_fit.images.overlay import shaded

Floats = NDArray[np.float64]

_LOOKED_AT = 24
"""Frames that the report is about; those that add most."""
_SHOWN, _HEIGHT, _WIDTH = 2, 360, 480
"""Frames of a row of images alone, twice as many above their depths; and the room of one, pixels."""
_ACROSS, _DISC, _ALIKE = 120, 2.0, 0.97
"""Points across an image, their radius in the view from above, pixels, and the cosine of directions that are one."""
_BACKGROUND = np.array([249.0, 249.0, 247.0])


@dataclass(frozen=True, eq=False)
class InspectedRecording:
    """report: plain values, the recording's unit and pixels · picture: some images, and the surface from above with the
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
    known = "as given" if said and said.depth_unit else "a guess" if guessed else "the recording"
    report = {
        "kind": "recording",
        "layout": recording.layout,
        "frames": len(recording),
        "unit": "meters" if recording.is_metric else "from the recording",
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
            "lens": "none" if stored.camera.lens == "none" else f"{stored.camera.lens}, removed from the images",
        },
        "bounds": [[_rounded(value) for value in row] for row in chosen.bounds.tolist()],
        "path": _rounded(float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())),
        "agreement": _agreement(recording),
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


def _agreement(recording: Recording) -> str:
    """How the depths of one surface agree from frame to frame, in words."""
    if len(recording) < 2:
        return "one frame: nothing to compare"
    try:
        return check_recording(recording) or "frames that show the same place agree"
    except DatasetError as error:
        return f"{error.reason}: {error}. {error.hint or ''}".strip()


def _picture(frames: list[Frame], places: Floats) -> Image.Image:
    """Color above depth of some frames, and beside them the points from above."""
    rows = 1 if all(one.color is None for one in frames) else 2
    picked = [frames[at] for at in np.unique(np.linspace(0, len(frames) - 1, _SHOWN * rows).astype(int))]
    height, width = _HEIGHT // rows, _WIDTH // rows
    sheet = Image.new("RGB", (width * len(picked) + _HEIGHT, _HEIGHT), (249, 249, 247))
    for number, frame in enumerate(picked):
        for row, image in enumerate((frame.color, shaded(frame))[-rows:]):
            if image is not None:
                shown = ImageOps.contain(Image.fromarray(image), (width, height))
                at = number * width + (width - shown.width) // 2, row * height + (height - shown.height) // 2
                sheet.paste(shown, at)
    sheet.paste(_from_above(frames, places, _HEIGHT), (width * len(picked), 0))
    return sheet


def _from_above(frames: list[Frame], places: Floats, edge: int) -> Image.Image:
    """The surface below the highest camera; the cameras' path, from the orange end to the blue one. The cameras look up
    in the picture."""
    cloud = Surfels.join(*map(_surface, frames))
    axes = np.stack([one.T_world_camera[:3, :3] for one in frames]).mean(axis=0)
    down = _down(cloud.normals, axes[:, 1])
    below = cloud.points @ down > (places @ down).min()
    if below.any():
        cloud = Surfels(cloud.points[below], cloud.normals[below], cloud.colors[below])
    low, high = np.quantile(cloud.points, (0.01, 0.99), axis=0)
    within = ((cloud.points >= low) & (cloud.points <= high)).all(axis=1)
    view = view_from(-down, axes[:, 2] - axes[:, 1], np.concatenate([cloud.points[within], places]), edge)
    pixels = (render(cloud, view, edge, _DISC / view.pixels_per_unit, _BACKGROUND / 255.0) * 255.0).astype(np.uint8)
    shown = Image.fromarray(pixels)
    draw = ImageDraw.Draw(shown)
    line = [(edge / 2.0 + x, edge / 2.0 - y) for x, y, _ in (places - view.center) @ view.axes.T * view.pixels_per_unit]
    orange, blue = (tuple(int(255 * part) for part in color) for color in (OBJECT_COLOR, SCENE_COLOR))
    draw.line(line, fill=orange, width=2)
    for (x, y), color in ((line[-1], blue), (line[0], orange)):
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=color)
    return shown


def _surface(frame: Frame) -> Surfels:
    """Some of what a frame shows, world."""
    step = max(1, frame.depth.shape[1] // _ACROSS)
    image = shaded(frame) if frame.color is None else frame.registered(frame.color)
    rows, columns = np.indices(frame.depth.shape)[:, ::step, ::step]
    depth = frame.depth[rows, columns]
    rays = frame.camera.rays(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5).reshape(*depth.shape, 3)
    places = (rays * depth[..., None]) @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
    normals = np.cross(places[1:, :-1] - places[:-1, :-1], places[:-1, 1:] - places[:-1, :-1])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    known = (depth[1:, :-1] > 0.0) & (depth[:-1, 1:] > 0.0) & (depth[:-1, :-1] > 0.0)
    return Surfels(places[:-1, :-1][known], normals[known], image[rows, columns][:-1, :-1][known] / 255.0)


def _down(normals: Floats, own: Floats) -> Floats:
    """(3,): the direction, within 60 degrees of the images' ``own`` down, that most of the surface lies across."""
    own = own / max(float(np.linalg.norm(own)), 1e-9)
    facing = normals * np.sign(normals @ own)[:, None]
    facing = facing[facing @ own > 0.5]
    if not len(facing):
        return own
    tried = facing[:: len(facing) // 300 + 1]
    best = tried[int((tried @ facing.T > _ALIKE).sum(axis=1).argmax())]
    down = facing[facing @ best > _ALIKE].sum(axis=0)
    return np.asarray(down / np.linalg.norm(down))

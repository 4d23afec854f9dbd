"""The images of a recording of any layout that a fit or a fusion takes: the frames that add most, and their bounds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from regnf_core.geometry.box import OrientedBox
from regnf_data.posed_images import PosedImages
from regnf_data.recordings.camera import Array
from regnf_data.recordings.choosing import choose_frames
from regnf_data.recordings.documents import is_sdfstudio
from regnf_data.recordings.layouts import SDFSTUDIO
from regnf_data.recordings.opening import open_recording
from regnf_data.recordings.recording import Given
from regnf_data.sdfstudio import load_dataset, read_metadata

MOST_FRAMES = 80
_MOST_PIXELS = 1 << 24
"""Of all frames that are held at once: a fusion takes some 130 bytes for each."""


@dataclass(frozen=True, eq=False)
class TakenImages:
    """images: in the recording's world · notes: what was taken for granted, found and left out."""

    images: PosedImages
    notes: tuple[str, ...] = ()


def images_of(
    path: str | os.PathLike[str],
    given: Given | None = None,
    bounds: Array | None = None,
    most: int = MOST_FRAMES,
    progress: Callable[[int, int], None] | None = None,
) -> TakenImages:
    """The images at ``path``. A folder of sdfstudio is taken whole, with its masks, objects and bounds.

    bounds: (2, 3), world; None: round what the depths show · most: frames; fewer where they are large.
    Raises DatasetError.
    """
    given, source = given or Given(), Path(path)
    if is_sdfstudio(source) and given == Given(axes=given.axes):
        return _of_sdfstudio(source, given, bounds)
    recording = open_recording(source, given)
    pixels = recording.frames[0].read(color=False).depth.size
    box = None if bounds is None else OrientedBox.from_corners(*bounds)
    chosen = choose_frames(recording, max(1, min(most, _MOST_PIXELS // pixels)), box, progress)
    images = recording.posed_images(chosen.indices, chosen.bounds if bounds is None else bounds)
    notes = list(recording.notes)
    if len(images) < len(recording):
        notes.append(f"{len(images)} of {len(recording)} frames are used: those that add most new surface")
    if bounds is None:
        notes.append(_found(chosen.bounds))
    return TakenImages(images, tuple(notes))


def _of_sdfstudio(folder: Path, given: Given, bounds: Array | None) -> TakenImages:
    """All images. Without a ``scene_box`` the bounds are sdfstudio's usual cube, unless the depths leave it."""
    terms = replace(SDFSTUDIO, axes=given.axes or "opencv")
    images = replace(load_dataset(folder, given.axes == "opengl"), terms=terms)
    if bounds is not None:
        return TakenImages(replace(images, bounds=bounds))
    if images.depths is None or images.masks is not None or "scene_box" in read_metadata(folder):
        return TakenImages(images)
    found = choose_frames(open_recording(folder, given), 1).bounds
    if ((found[0] >= images.bounds[0]) & (found[1] <= images.bounds[1])).all():
        return TakenImages(images)
    return TakenImages(replace(images, bounds=found), (_found(found),))


def _found(bounds: Array) -> str:
    low, high = ("(" + ", ".join(f"{value:.4g}" for value in row) + ")" for row in bounds)
    return f"bounds around the measured depths: {low} to {high}"

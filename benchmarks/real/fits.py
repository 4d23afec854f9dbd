"""Fields by ``regnf fit`` at its defaults: of a half's room, and of its things from the frames that see them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.real.cases import Work, object_fit_frame
from benchmarks.real.maps import bounds_of, fit_frame
from benchmarks.real.scenes import Thing
from benchmarks.real.sequence import Floats, Recording, posed_images
from regnf_data.posed_images import PosedImages
from regnf_fit.images.fit import FitFiles, reconstruct
from regnf_fit.options import ReconstructionOptions

_ROOM_IMAGES, _OBJECT_IMAGES = 125, 40
_LOOKED_AT = 8
"""Every so many pixels along both axes tell whether a frame sees a thing."""


def fit_room(recording: Recording, frames: range, work: Work, half: str, options: ReconstructionOptions) -> None:
    """Write the half's room."""
    files = work.map_files(half)
    T = fit_frame(files.fused)
    corners = bounds_of(files.fused)
    bounds = float(T.scale) * corners + T.translation.numpy()
    chosen = frames[:: max(1, len(frames) // _ROOM_IMAGES)]
    _fit(posed_images(recording, chosen, T, bounds, stride=2), files.fit, options)


def fit_thing(recording: Recording, frames: range, work: Work, thing: Thing, options: ReconstructionOptions) -> None:
    """Write the thing's field, from the frames that see most of it."""
    T_field_room = object_fit_frame(thing)
    T = T_field_room @ thing.T_room_world
    half = float(T_field_room.scale) * (thing.high - thing.low) / 2.0
    chosen = seeing(recording, frames, thing, _OBJECT_IMAGES)
    _fit(posed_images(recording, chosen, T, np.stack([-half, half])), work.object_file(thing, "fit"), options)


def seeing(recording: Recording, frames: Sequence[int], thing: Thing, limit: int) -> list[int]:
    """The frames with most depths in the thing's box, at most so many, in order."""
    counts = [_pixels_within(recording, frame, thing) for frame in frames]
    best = np.argsort(counts)[::-1][:limit]
    return sorted(frames[i] for i in best if counts[i] > 0)


def _pixels_within(recording: Recording, frame: int, thing: Thing) -> int:
    depth = recording.depth(frame)[::_LOOKED_AT, ::_LOOKED_AT].astype(np.float64)
    row, column = (index * float(_LOOKED_AT) for index in np.indices(depth.shape))
    rays: Floats = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(recording.intrinsics).T
    T = recording.pose(frame)
    points = (rays * depth[..., None])[depth > 0.0] @ T[:3, :3].T + T[:3, 3]
    points = points @ thing.T_room_world.rotation.numpy().T
    return int(((points > thing.low) & (points < thing.high)).all(axis=1).sum())


def _fit(images: PosedImages, path: Path, options: ReconstructionOptions) -> None:
    report = reconstruct(images, FitFiles(path, path.with_suffix(".checkpoint")), options, device="cpu")
    path.with_suffix(".json").write_text(json.dumps(asdict(report), indent=1) + "\n")

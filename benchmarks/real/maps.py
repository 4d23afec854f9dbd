"""The room of one half of a sequence as a field in the world frame, with or without what was observed of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.real.fusion import open_fused, surface
from benchmarks.real.sequence import Floats, Recording, posed_images
from regnf_core import SdfField, Sim3
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import Observation, ObservedField
from regnf_core.loading import open_field
from regnf_fit.images.observing import depth_spread, local_planes, observe

MAPS = ("fused", "fit")
OBSERVATIONS = ("frames", "file", "none")
"""Made from the map's frames; what the map's own file tells; none at all."""
_VOXELS = 512
_SEEING = 42
"""Frames of the half, about, that tell what was observed."""
_MARGIN_M = 0.05
_EXTENT = 3.8
"""Of a room that is fitted, field units: the hash grid's cube has 4."""


@dataclass(frozen=True)
class MapFiles:
    """fused: one half's map by Open3D · fit: by ``regnf fit`` · seen: what its frames observed."""

    folder: Path
    halves: str
    half: str

    @property
    def fused(self) -> Path:
        return self.folder / f"{self.halves}-{self.half}.npz"

    @property
    def fit(self) -> Path:
        return self.folder / f"{self.halves}-{self.half}.fit.safetensors"

    @property
    def seen(self) -> Path:
        return self.folder / f"{self.halves}-{self.half}.seen.npz"


def bounds_of(fused: Path) -> Floats:
    """(2, 3): round the fused surface, world frame."""
    vertices, _ = surface(fused)
    return np.stack([vertices.min(axis=0) - _MARGIN_M, vertices.max(axis=0) + _MARGIN_M])


def fit_frame(fused: Path) -> Sim3:
    """T_field_world of a room that is fitted: centered, its longest edge a little shorter than the grid's cube."""
    low, high = bounds_of(fused)
    scale = torch.tensor(_EXTENT / (high - low).max(), dtype=torch.float64)
    center = torch.from_numpy((low + high) / 2.0)
    return Sim3(scale, torch.eye(3, dtype=torch.float64), -scale * center)


def keep_observation(recording: Recording, frames: range, files: MapFiles) -> None:
    """Write what the half's frames observed."""
    every = max(1, round(len(frames) / _SEEING))
    images = posed_images(recording, frames[::every], Sim3.identity(), bounds_of(files.fused), stride=2)
    assert images.depths is not None
    spread = depth_spread(images, local_planes(images.depths, images.intrinsics).cosines)
    seen = observe(images, _VOXELS, spread)
    assert seen is not None
    np.savez_compressed(files.seen, states=seen.states.numpy(), low=seen.low.numpy(), voxel=seen.voxel)


def open_map(files: MapFiles, kind: str, observed: str) -> SdfField:
    """The map in the world frame. kind: of MAPS · observed: of OBSERVATIONS."""
    field = open_fused(files.fused) if kind == "fused" else open_field(files.fit)
    if observed != "file" and isinstance(field, ObservedField):
        field = field.field
    if kind == "fit":
        field = TransformedField(field, fit_frame(files.fused))
    if observed != "frames":
        return field
    stored = np.load(files.seen)
    seen = Observation(torch.from_numpy(stored["states"]), torch.from_numpy(stored["low"]), float(stored["voxel"]))
    return ObservedField(field, seen)

"""Fields of furnished rooms with what was registered in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.robust.cases import Pair, load_pairs
from regnf_core import RegistrationResult, SdfField, Sim3, open_field, register
from regnf_core.rendering.camera import Camera

TINTS = (
    (0.93, 0.55, 0.20),
    (0.27, 0.56, 0.86),
    (0.40, 0.72, 0.38),
    (0.80, 0.36, 0.60),
    (0.85, 0.75, 0.25),
)
"""Of the objects of a room, in order."""


@dataclass(frozen=True, eq=False)
class Found:
    """An object that was registered in a room.

    T_object_scene: as registered · residual: object units · points: (N, 3) of its surface, object frame.
    """

    pair: Pair
    obj: SdfField
    T_object_scene: Sim3
    residual: float
    verdict: str
    points: Tensor


def pairs_of(fields: Path, name: str, room: str) -> list[Pair]:
    """The pairs of one room in a list of pairs; none where the list is missing."""
    return [pair for pair in load_pairs(fields, name) if pair.room == room]


def found(pair: Pair, scene: SdfField, obj: SdfField | None = None) -> Found:
    """Register the pair's object, whatever the verdict says of it."""
    thing = obj if obj is not None else open_field(pair.folder / f"{pair.object}.safetensors")
    result: RegistrationResult = register(scene, thing, pair.detection, clouds=False)
    residual = result.metrics.get("residual_rms", 0.0) * pair.diameter
    return Found(pair, thing, result.T_object_scene, residual, result.verdict, result.object_samples.points)


def overview(scene: SdfField, size: tuple[int, int]) -> Camera:
    """From the open corner, above most things: the rooms' walls are at their low x and y."""
    low, high = scene.bounds
    at = low + (high - low) * torch.tensor([0.97, 0.97, 0.93], dtype=torch.float64)
    to = low + (high - low) * torch.tensor([0.42, 0.42, 0.15], dtype=torch.float64)
    return Camera.look_at(at, to, size, 68.0)

"""One registration of a thing cut from one half with the map of the other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.real.halves import Halves
from benchmarks.real.maps import MapFiles
from benchmarks.real.objects import open_object
from benchmarks.real.scenes import Thing, placement
from benchmarks.robust.cases import Case
from regnf_core import SdfField, Sim3
from regnf_core.fields.composite import TransformedField


@dataclass(frozen=True)
class Work:
    """The folder that the commands keep their files in, for one recording cut in two."""

    folder: Path
    halves: Halves

    def map_files(self, half: str) -> MapFiles:
        """half: A, that objects are cut from, or B."""
        return MapFiles(self.folder, self.halves.name, half)

    def object_file(self, thing: Thing, kind: str) -> Path:
        """Of a thing cut from half A. kind: of objects.KINDS."""
        ending = {"points": "ply", "grid": "npz", "fit": "safetensors"}[kind]
        return self.folder / f"{self.halves.name}-{thing.name.replace(' ', '-')}.{kind}.{ending}"


def object_field(work: Work, thing: Thing, kind: str) -> SdfField:
    """The thing in the room's frame."""
    field = open_object(work.object_file(thing, kind))
    if kind != "fit":
        return field
    return TransformedField(field, object_fit_frame(thing))


def object_fit_frame(thing: Thing) -> Sim3:
    """T_field_room of a thing that is fitted: its box centered, its longest edge of length 2."""
    scale = torch.tensor(2.0 / (thing.high - thing.low).max(), dtype=torch.float64)
    center = torch.from_numpy((thing.low + thing.high) / 2.0)
    return Sim3(scale, torch.eye(3, dtype=torch.float64), -scale * center)


def make_case(scene: SdfField, obj: SdfField, thing: Thing, number: int, seed: int) -> Case:
    """scene: world frame · obj: room frame · number: the thing's among those of its scene."""
    placed = placement(thing, number, seed)
    T_room_object = thing.T_room_world @ placed.T_object_world.inverse()
    moved = TransformedField(obj, T_room_object)
    return Case(thing.name, scene, moved, placed.detection, placed.T_object_world)

"""Which things of a recorded scene are cut out, and where detections of them lie."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.real.sequence import Floats
from regnf_core import OrientedBox, Sim3

_FILE = Path(__file__).with_name("boxes.json")
_LOOSER, _SHIFT = 1.2, 0.05
"""A detection's size and how far it lies off, in sizes of the box that the object was cut by."""
_SCALES = (0.5, 2.0)


@dataclass(frozen=True, eq=False)
class Thing:
    """A box round a thing, aligned with the room: low, high (3,) in the room's frame, whose z axis points up."""

    name: str
    low: Floats
    high: Floats
    T_room_world: Sim3

    def box(self) -> OrientedBox:
        """The box that the object is cut by, world frame."""
        center = torch.from_numpy((self.low + self.high) / 2.0)[None]
        T = self.T_room_world.inverse()
        return OrientedBox(T.apply(center)[0], torch.from_numpy(self.high - self.low), T.rotation, self.name)


@dataclass(frozen=True, eq=False)
class RecordedScene:
    """voxel_m: from node to node of its maps · things: those that are cut out."""

    voxel_m: float
    things: tuple[Thing, ...]


def scene_of(name: str) -> RecordedScene:
    """From boxes.json. The boxes were found by eye in pictures of the fused room."""
    entry = json.loads(_FILE.read_text())[name]
    T = room_frame(np.array(entry["up"]))
    things = tuple(Thing(each, np.array(box[0]), np.array(box[1]), T) for each, box in entry["boxes"].items())
    return RecordedScene(float(entry["voxel_m"]), things)


def scene_names() -> tuple[str, ...]:
    """Of the scenes whose boxes are known."""
    return tuple(json.loads(_FILE.read_text()))


def room_frame(up: Floats) -> Sim3:
    """T_room_world: z points up, x is the world's x made level."""
    z = up / np.linalg.norm(up)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    rotation = torch.from_numpy(np.stack([x, np.cross(z, x), z]))
    return Sim3(torch.ones((), dtype=torch.float64), rotation, torch.zeros(3, dtype=torch.float64))


@dataclass(frozen=True)
class Placement:
    """T_object_world: a random similarity, the truth · detection: looser than the thing's box and off its center."""

    T_object_world: Sim3
    detection: OrientedBox


def placement(thing: Thing, number: int, seed: int) -> Placement:
    """Of the scene's ``number``-th thing; another one for each seed."""
    rng = np.random.default_rng([seed, number])
    quaternion = rng.normal(size=4)
    scale = float(np.exp(rng.uniform(*np.log(_SCALES))))
    box = thing.box()
    T = Sim3.from_quaternion(scale, quaternion.tolist(), rng.normal(size=3).tolist())
    shift = torch.from_numpy(rng.uniform(-_SHIFT, _SHIFT, 3)) * box.size
    detection = OrientedBox(box.center + box.rotation @ shift, _LOOSER * box.size, box.rotation, thing.name)
    return Placement(T, detection)

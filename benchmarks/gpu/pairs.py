"""What is registered: a room, a detection, an object, by the paths of the fields; and boxes a little off."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

from benchmarks.robust.cases import KINDS, load_pairs
from regnf_core import OrientedBox, SdfField, open_field
from regnf_core.robust.model import ObjectModel, model_object

DEMO = Path(__file__).parents[2] / "examples" / "data"
_OFF = 0.03
"""Share of a box's edges by which a box in a batch is moved and resized."""


@dataclass(frozen=True, eq=False)
class Pair:
    """room, object: paths of their fields · detection: a box in the room's frame · right: whether it shows the
    object."""

    room: Path
    object: Path
    detection: OrientedBox
    right: bool

    @property
    def name(self) -> str:
        """The fields' names."""
        return f"{self.room.stem}, {self.object.stem}{'' if self.right else ' (not in the box)'}"


def demo_pairs() -> list[Pair]:
    """The demo's two detections, each with both objects."""
    boxes = {"armchair": "detection", "dining-chair": "detection-dining-chair"}
    found = []
    for shown, name in boxes.items():
        said = json.loads((DEMO / f"{name}.json").read_text(encoding="utf-8"))
        box = OrientedBox.from_quaternion(said["center"], said["size"], said["rotation_quaternion_xyzw"])
        found += [Pair(_demo("mix-room"), _demo(other), box, other == shown) for other in boxes]
    return found


def _demo(name: str) -> Path:
    return DEMO / f"{name}.safetensors"


def pairs_in(folder: Path) -> list[Pair]:
    """The benchmark's pairs, and each detection with the object of the pair before it. Raises SystemExit without."""
    known = [pair for file in KINDS.values() for pair in load_pairs(folder, file)]
    if not known:
        raise SystemExit(f"{folder} holds no pairs: fill it with benchmarks.make_fields, or give no folder")
    found = []
    for number, pair in enumerate(known):
        room = folder / f"{pair.room}.safetensors"
        found.append(Pair(room, folder / f"{pair.object}.safetensors", pair.detection, True))
        other = known[number - 1]
        if other.instance != pair.instance:
            found.append(Pair(room, folder / f"{other.object}.safetensors", pair.detection, False))
    return found


@cache
def field_at(path: Path, device: str) -> SdfField:
    """The field on the device; opened once."""
    return open_field(path).to(device)


@cache
def model_at(path: Path, device: str) -> ObjectModel:
    """The model of the object's field, made once on the device."""
    return model_object(field_at(path, device))


def batch_of(pairs: Sequence[Pair], count: int, seed: int = 0) -> list[Pair]:
    """``count`` right pairs of one room, the one with the most, each with a box of its own, a little off."""
    right = [pair for pair in pairs if pair.right]
    ((room, _),) = Counter(pair.room for pair in right).most_common(1)
    base = [pair for pair in right if pair.room == room]
    generator = torch.Generator().manual_seed(seed)
    found = []
    for number in range(count):
        pair = base[number % len(base)]
        move, grow = (_OFF * (2 * torch.rand(3, generator=generator, dtype=torch.float64) - 1) for _ in range(2))
        box = pair.detection
        moved = OrientedBox(box.center + box.rotation @ (move * box.size), box.size * (1 + grow), box.rotation)
        found.append(Pair(pair.room, pair.object, moved, True))
    return found

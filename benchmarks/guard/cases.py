"""What the guard times. Everything here is public API that both commits have.

The fields are the demo's, the same at full size, and the demo's room as a regular grid of distances.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch

from regnf_core import OrientedBox, open_field
from regnf_core.batch import register_batch
from regnf_core.library import LibraryObject, register, search_library
from regnf_core.robust.model import model_object

POINTS = 5_000
OBJECTS = 512
ROOM, OBJECT = "mix-room", "armchair"
FULL_SIZE, GRID = "-full-size", "-grid"


@dataclass(frozen=True)
class Case:
    """One thing to time. make: sets it up, in time that does not count, and gives what is timed; that takes the
    number of the run."""

    name: str
    make: Callable[[Path], Callable[[int], Any]]


def cases() -> list[Case]:
    """All cases, by the names that the command takes."""
    pairs = {
        "small": (ROOM, OBJECT),
        "full-size": (ROOM + FULL_SIZE, OBJECT + FULL_SIZE),
        "grid": (ROOM + GRID, OBJECT),
    }
    found = []
    for name, (room, thing) in pairs.items():
        found.append(Case(f"{name}, model kept", partial(_kept, room, thing)))
        found.append(Case(f"{name}, cold", partial(_cold, room, thing)))
        found.append(Case(f"{name}, evaluator", partial(_evaluator, room)))
    found.append(Case("small, clouds too", partial(_clouds, ROOM, OBJECT)))
    found.append(Case("small, batch of 4", _batch))
    found.append(Case(f"library of {OBJECTS}", _library))
    return found


@cache
def _field(folder: Path, name: str) -> Any:
    return open_field(folder / f"{name}.safetensors")


@cache
def _model(folder: Path, name: str) -> Any:
    return model_object(_field(folder, name))


def _box(folder: Path, name: str = "detection") -> OrientedBox:
    said = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    return OrientedBox.from_quaternion(said["center"], said["size"], said["rotation_quaternion_xyzw"])


def _kept(room: str, thing: str, folder: Path) -> Callable[[int], Any]:
    scene, obj, box, model = _field(folder, room), _field(folder, thing), _box(folder), _model(folder, thing)
    return lambda seed: register(scene, obj, box, seed=seed, object_model=_as_read(model), clouds=False)


def _cold(room: str, thing: str, folder: Path) -> Callable[[int], Any]:
    scene, obj, box = _field(folder, room), _field(folder, thing), _box(folder)
    return lambda seed: register(scene, obj, box, seed=seed, clouds=False)


def _clouds(room: str, thing: str, folder: Path) -> Callable[[int], Any]:
    scene, obj, box, model = _field(folder, room), _field(folder, thing), _box(folder), _model(folder, thing)
    return lambda seed: register(scene, obj, box, seed=seed, object_model=_as_read(model))


def _as_read(model: Any) -> Any:
    """The model as its file gives it: what it makes of its samples when asked is made again."""
    return replace(model)


def _evaluator(room: str, folder: Path) -> Callable[[int], Any]:
    """Value and gradient at points spread evenly over the bounds."""
    field = _field(folder, room)
    low, high = (corner.float() for corner in field.bounds)
    points = low + torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0)) * (high - low)
    return lambda _: field.signed_distance_and_gradient(points)


def _batch(folder: Path) -> Callable[[int], Any]:
    """Two detections with two objects each: what they share is to be made once."""
    scene, objects = _field(folder, ROOM), [_field(folder, name) for name in (OBJECT, "dining-chair")]
    boxes = [_box(folder), _box(folder, "detection-dining-chair")]
    return lambda seed: register_batch(scene, boxes, objects, seed=seed, clouds=False)


def _library(folder: Path) -> Callable[[int], Any]:
    """The demo's two objects under many names: the coarse search meets as many alike as it can."""
    names = (OBJECT, "dining-chair")
    library = [
        LibraryObject(f"{number}", partial(_field, folder, names[number % 2]), _model(folder, names[number % 2]))
        for number in range(OBJECTS)
    ]
    scene, box = _field(folder, ROOM), _box(folder)
    return lambda seed: search_library(scene, box, library, seed=seed)

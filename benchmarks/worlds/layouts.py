"""A furnished room on paper: floor, walls, and which mesh stands where. Meters, z up."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_USUAL_UNITS_PER_METER = 0.5
_USUAL_ORIGIN_M = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Furnishing:
    """One piece of furniture. mesh: its file · T_room_mesh: (4, 4) rigid · bounds: (2, 3) in the room, if stated."""

    name: str
    mesh: Path
    T_room_mesh: Array
    bounds: Array | None


@dataclass(frozen=True)
class Layout:
    """floor, walls: (2, 3) each · units_per_meter, origin_m: of the world frame, the room's less origin times units."""

    name: str
    floor: Array
    walls: tuple[Array, ...]
    furnishings: tuple[Furnishing, ...]
    units_per_meter: float = _USUAL_UNITS_PER_METER
    origin_m: tuple[float, float, float] = _USUAL_ORIGIN_M


def read_layout(path: str | os.PathLike[str], meshes: str | os.PathLike[str]) -> Layout:
    """The layout in a JSON file; of a mesh's path the last part alone counts, as a file of the folder ``meshes``."""
    room = json.loads(Path(path).read_bytes())
    return Layout(
        name=Path(path).stem,
        floor=_corners(room["floor"], "box"),
        walls=tuple(_corners(wall, "box") for wall in room.get("walls", [])),
        furnishings=tuple(_furnishing(instance, Path(meshes)) for instance in room["instances"]),
        units_per_meter=room.get("scene_units_per_meter", _USUAL_UNITS_PER_METER),
        origin_m=tuple(room.get("scene_origin_m", _USUAL_ORIGIN_M)),
    )


def _furnishing(instance: dict[str, Any], meshes: Path) -> Furnishing:
    bounds = None if instance.get("aabb_min") is None else _corners(instance, "aabb")
    pose = np.array(instance["T_room_from_object"], dtype=np.float64)
    return Furnishing(instance["id"], meshes / Path(instance["mesh"]).name, pose, bounds)


def _corners(given: dict[str, Any], name: str) -> Array:
    return np.array([given[f"{name}_min"], given[f"{name}_max"]], dtype=np.float64)

"""A furnished room on paper: floor, walls, and which mesh stands where. Meters, z up."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from regnf_core.errors import DatasetError
from regnf_data.sdfstudio import array, rigid

Array = NDArray[np.float64]

_REASON = "DATASET_LAYOUT_INVALID"
_USUAL_UNITS_PER_METER = 0.5
_LONGEST_NAME = 200
_LONGEST_FILE_NAME = 255
"""Bytes; with more, file systems answer an error rather than that there is no such file."""
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
    """The layout in a JSON file; of a mesh's path the last part alone counts, as a file of the folder ``meshes``.

    Raises DatasetError (DATASET_LAYOUT_INVALID, DATASET_MESH_MISSING) and OSError.
    """
    source = Path(path)
    try:
        room = json.loads(source.read_bytes())
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{source.name} is not JSON: {error}", reason=_REASON) from error
    if not isinstance(room, dict) or not isinstance(room.get("walls", []), list):
        raise DatasetError(f"{source.name} is not a layout: an object with floor, walls, instances", reason=_REASON)
    instances = room.get("instances")
    if not isinstance(instances, list) or not instances:
        raise DatasetError(f"{source.name} lists no instances", reason=_REASON)
    units = float(array(room.get("scene_units_per_meter", _USUAL_UNITS_PER_METER), ((),), "scene units", _REASON))
    if units <= 0.0:
        raise DatasetError("scene_units_per_meter is not positive", reason=_REASON)
    x, y, z = array(room.get("scene_origin_m", _USUAL_ORIGIN_M), ((3,),), "scene_origin_m", _REASON).tolist()
    return Layout(
        name=source.stem,
        floor=_corners(room.get("floor"), "floor"),
        walls=tuple(_corners(wall, "a wall") for wall in room.get("walls", [])),
        furnishings=tuple(_furnishing(instance, Path(meshes)) for instance in instances),
        units_per_meter=units,
        origin_m=(x, y, z),
    )


def _furnishing(instance: Any, meshes: Path) -> Furnishing:
    if not isinstance(instance, dict) or not all(isinstance(instance.get(key), str) for key in ("id", "mesh")):
        raise DatasetError("an instance has no id or no mesh", reason=_REASON)
    name = instance["id"]
    if not name.isprintable() or len(name) > _LONGEST_NAME:
        raise DatasetError("an instance's id has control characters or is too long", reason=_REASON)
    mesh = meshes / Path(instance["mesh"]).name
    if "\0" in mesh.name or len(mesh.name.encode("utf-8", "surrogatepass")) > _LONGEST_FILE_NAME or not mesh.is_file():
        raise DatasetError(f"{name}: no such mesh: {mesh.name!r:.200}", reason="DATASET_MESH_MISSING")
    stated = instance.get("aabb_min") is not None
    bounds = _corners(instance, name, "aabb_min", "aabb_max") if stated else None
    pose = rigid(instance.get("T_room_from_object"), f"T_room_from_object of {name}", _REASON)
    return Furnishing(name, mesh, pose, bounds)


def _corners(given: Any, what: str, lowest: str = "box_min", highest: str = "box_max") -> Array:
    if not isinstance(given, dict):
        raise DatasetError(f"{what} is not a box", reason=_REASON)
    corners = np.stack([array(given.get(key), ((3,),), f"{key} of {what}", _REASON) for key in (lowest, highest)])
    if not (corners[0] < corners[1]).all():
        raise DatasetError(f"{what}: {lowest} is not below {highest}", reason=_REASON)
    return corners

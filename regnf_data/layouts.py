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

# Numbers and matrices out of a dataset's JSON, checked.

_RIGID_TOLERANCE = 1e-3
"""Of rotations and scales: files are often written with few digits."""


_LARGEST = 1e9
"""Larger numbers are neither places nor pixels, and their products overflow."""


def array(value: Any, shapes: tuple[tuple[int, ...], ...], what: str, reason: str) -> NDArray[np.float64]:
    """``value`` as float64 numbers of one of the shapes, finite and up to 1e9. Raises DatasetError (``reason``)."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.shape not in shapes or not (np.abs(numbers) <= _LARGEST).all():  # NaN is not either
        wanted = " or ".join(" x ".join(map(str, shape)) for shape in shapes)
        raise DatasetError(f"{what} is not {wanted} finite numbers, none beyond {_LARGEST:g}", reason=reason)
    return numbers


def matrix4(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """An affine (4, 4) matrix; the last row may be left out."""
    given = array(value, ((4, 4), (3, 4)), what, reason)
    matrix = np.eye(4)
    matrix[: len(given)] = given
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-9):
        raise DatasetError(f"{what} is not an affine transform: its last row is not 0 0 0 1", reason=reason)
    return matrix


def rigid(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """A rotation and a translation, (4, 4)."""
    matrix = matrix4(value, what, reason)
    rotation = matrix[:3, :3]
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    if not straight or np.linalg.det(rotation) < 0.0:
        raise DatasetError(f"{what} is not a rotation and a translation", reason=reason)
    return matrix


def similarity(value: Any, what: str, reason: str) -> NDArray[np.float64]:
    """A rotation, one positive scale and a translation, (4, 4)."""
    matrix = matrix4(value, what, reason)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant <= 0.0:
        raise DatasetError(f"{what} is not a similarity: its determinant is not positive", reason=reason)
    rotation = matrix[:3, :3] / np.cbrt(determinant)
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE):
        raise DatasetError(f"{what} is not a similarity: it shears or scales unevenly", reason=reason)
    return matrix


def whole_number(value: Any, what: str, reason: str) -> int:
    """A positive whole number."""
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole or value < 1:
        raise DatasetError(f"{what} is not a positive whole number", reason=reason)
    return int(value)


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

"""Registrations to run, from the folders that ``making`` wrote."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from benchmarks.robust.bent_field import BentField
from benchmarks.robust.cases import Case
from benchmarks.robust.symmetries import in_frame
from benchmarks.symmetric_errors import Symmetries
from benchmarks.worlds.making import SCENE, WORLD, read_cameras, read_observation_grid, read_recording
from benchmarks.worlds.observing import observation_of_cameras
from regnf_core import OrientedBox, RegnfError, SdfField, Sim3
from regnf_core.fields.build import open_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.mesh import MeshField
from regnf_core.fields.observation import Observation, ObservedField, observation_of, stored_observation
from regnf_fit.images.recorded_scene import recorded_scene

ObservedBy = Literal["images", "cameras", "map", "nothing", "recording"]
"""What tells what was seen of a scene: the walk's images, where its cameras stood alone, the map's own file, or
nothing. `recording`: the walk's frames are the scene, in place of the map."""
OBSERVED_BY: tuple[ObservedBy, ...] = ("images", "cameras", "map", "nothing", "recording")


@dataclass(frozen=True, eq=False)
class WorldCase:
    """A registration with what is known of it.

    facts: what tables group by · points: (N, 3) of the object's true surface, its frame · near: symmetries, with those
    that nearly hold · seen: what the walk's images saw, whatever the scene is told of it, scene frame.
    """

    case: Case
    facts: dict[str, Any]
    points: Tensor
    near: Symmetries
    seen: Observation


def cases_of(home: Path, by: ObservedBy = "images") -> Iterator[WorldCase]:
    """All cases of a world's folder. by: what tells what was seen of the scene."""
    world = json.loads((home / WORLD).read_text())
    T_scene_room = Sim3.from_matrix(world["T_scene_room"])
    recording = read_recording(home) if by == "recording" else None
    map_field = (
        None if recording else TransformedField(_observed(home, _scene(home, world), by), T_scene_room.inverse())
    )
    seen = _by_images(home).seen_in(T_scene_room.inverse())
    for number, known in enumerate(world["cases"]):
        box = known["detection"]
        in_room = OrientedBox(
            *(torch.tensor(box[name], dtype=torch.float64) for name in ("center", "size", "rotation"))
        )
        if recording is None:
            scene = map_field
        else:
            try:
                scene = TransformedField(recorded_scene(recording, in_room).field, T_scene_room.inverse())
            except RegnfError:  # no frame shows it
                continue
        assert scene is not None
        case = _case(home, number, (world, known), scene, seen)
        told = {"observed": observation_of(scene) is not None, "observed_by": by}
        yield replace(case, facts=case.facts | told)


def room_field(home: Path, by: ObservedBy = "images") -> tuple[SdfField, dict[str, Any]]:
    """The map of a world in the room's own frame, in meters, and what ``world.json`` says."""
    world = json.loads((home / WORLD).read_text())
    return _observed(home, _scene(home, world), by), world


def _case(
    home: Path, number: int, said: tuple[dict[str, Any], dict[str, Any]], scene: SdfField, seen: Observation
) -> WorldCase:
    world, known = said
    T_scene_room = Sim3.from_matrix(world["T_scene_room"])
    T_object_model = Sim3.from_matrix(known["T_object_model"])
    with np.load(home / f"object-{number}.npz") as file:
        arrays = {name: file[name] for name in file.files}
    exact, near = (
        in_frame(Symmetries.from_dict(json.loads(str(text))), T_object_model) for text in arrays["symmetries"]
    )
    box = known["detection"]
    in_room = OrientedBox(*(torch.tensor(box[name], dtype=torch.float64) for name in ("center", "size", "rotation")))
    detection = OrientedBox(
        T_scene_room.apply(in_room.center[None])[0],
        in_room.size * T_scene_room.scale,
        T_scene_room.rotation @ in_room.rotation,
    )
    case = Case(
        f"{home.name} {number} {known['name']}",
        scene,
        _object(home, number, known["field"], arrays, T_object_model),
        detection,
        Sim3.from_matrix(known["T_object_scene"]),
        exact,
    )
    points = T_object_model.apply(torch.from_numpy(arrays["surface"]))
    return WorldCase(case, _facts(home, number, world, known), points, near, seen)


def _object(home: Path, number: int, kind: str, arrays: dict[str, Any], T_object_model: Sim3) -> SdfField:
    if kind == "mesh":
        return MeshField(arrays["vertices"], arrays["faces"]).transformed(T_object_model.matrix().numpy())
    T_field_model = Sim3.from_matrix(arrays["T_field_model"]) if kind == "cut" else Sim3.identity()
    return TransformedField(open_field(home / f"object-{number}.safetensors"), T_field_model @ T_object_model.inverse())


def _scene(home: Path, world: dict[str, Any]) -> SdfField:
    field: SdfField
    told = world["scene"]
    if (home / SCENE).exists():
        field = open_field(home / SCENE)
        units = told.get("units_per_meter", 1.0)
        field = field if units == 1.0 else TransformedField(field, _scaled(units))
    else:
        with np.load(home / "scene.npz") as file:
            field = MeshField(file["vertices"], file["faces"])
        if told["kind"] == "bent":
            field = BentField(field, told["amplitude"], told["wavelength"], told["bend_seed"])
    return field


def _observed(home: Path, field: SdfField, by: ObservedBy) -> SdfField:
    """The scene's field, in the room's frame, with what was seen of it."""
    if by == "map":
        return field
    if by == "nothing":
        return ObservedField(field, None)
    if by == "cameras":
        return ObservedField(field, observation_of_cameras(field, read_cameras(home)))
    return ObservedField(field, _by_images(home))


def _by_images(home: Path) -> Observation:
    grid, words = read_observation_grid(home)
    return stored_observation(grid, torch.from_numpy(words))


def _scaled(factor: float) -> Sim3:
    return Sim3.from_matrix(torch.diag(torch.tensor([factor] * 3 + [1.0], dtype=torch.float64)))


def _facts(home: Path, number: int, world: dict[str, Any], known: dict[str, Any]) -> dict[str, Any]:
    sensor, fusion = world["sensor"], world["fusion"]
    return {
        "world": home.name,
        "part": world["part"],
        "kind": world["kind"],
        "length": world["length"],
        "walk": world["walk"],
        "scene": world["scene"]["kind"],
        "volume": fusion["volume"],
        "sensor": sensor["principle"],
        "pixels": f"{sensor['size'][1]}x{sensor['size'][0]}",
        "drift": world["drift"],
        "case": number,
        "object": known["name"],
        "field": known["field"],
        **{name: known[name] for name in ("seen", "diameter_m", "voxels_across", "drift_spread")},
    }

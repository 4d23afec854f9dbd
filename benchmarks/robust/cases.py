"""What there is to register: two fields, a detection, the truth; and the same seen in other frames."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.robust.symmetries import declared, in_frame
from benchmarks.symmetric_errors import Symmetries
from regnf_core import OrientedBox, SdfField, Sim3
from regnf_core import open_field as open_safe_field
from regnf_core.fields.composite import TransformedField
from regnf_core.fields.observation import ObservedField

MAIN, HELD_OUT, FULL_SIZE = "pairs.json", "pairs-held-out.json", "pairs-full-size.json"
KINDS = {"main": MAIN, "held out": HELD_OUT}
UNDER_TRAINED = ("pairs-after-3-percent.json", "pairs-after-10-percent.json")


@dataclass(frozen=True, eq=False)
class Case:
    """One registration to run. truth: T_object_scene; None when the object is not the one in the box."""

    name: str
    scene: SdfField
    obj: SdfField
    detection: OrientedBox
    truth: Sim3 | None
    symmetries: Symmetries = field(default_factory=Symmetries)

    def seen_in(self, T_new_scene: Sim3, T_new_object: Sim3) -> Case:
        """The same with the scene and the object in new frames; the detection turns with the scene."""
        box = self.detection
        detection = OrientedBox(
            T_new_scene.apply(box.center[None])[0], box.size * T_new_scene.scale, T_new_scene.rotation @ box.rotation
        )
        truth = None if self.truth is None else T_new_object @ self.truth @ T_new_scene.inverse()
        return Case(
            self.name,
            TransformedField(self.scene, T_new_scene.inverse()),
            TransformedField(self.obj, T_new_object.inverse()),
            detection,
            truth,
            in_frame(self.symmetries, T_new_object),
        )

    def unobserved(self) -> Case:
        """The same by a scene's field that does not say what was seen of it, as other trainers' fields do not."""
        return replace(self, scene=self.scene.field) if isinstance(self.scene, ObservedField) else self

    def in_box(self, detection: OrientedBox) -> Case:
        """The same with another detection box."""
        return replace(self, detection=detection)


@dataclass(frozen=True, eq=False)
class Pair:
    """A detection in a scene and the library's object that it shows, fields by name.

    instance: what the object is, whatever its field is called · diameter: of the object, its units.
    """

    folder: Path
    room: str
    object: str
    instance: str
    detection: OrientedBox
    truth: Sim3
    diameter: float

    @property
    def name(self) -> str:
        """Room and object."""
        return f"{self.room} {self.object}"

    def case(self) -> Case:
        """The right object in its detection."""
        scene, obj = open_field(self.folder, self.room), open_field(self.folder, self.object)
        return Case(self.name, scene, obj, self.detection, self.truth, declared(self.instance))

    def with_other(self, other: str) -> Case:
        """Another object in this detection."""
        scene, obj = open_field(self.folder, self.room), open_field(self.folder, other)
        return Case(f"{other} in {self.name}", scene, obj, self.detection, None)


def load_pairs(folder: Path, file: str = MAIN) -> list[Pair]:
    """The pairs that make_fields listed in ``file``; none where it is not there."""
    path = folder / file
    if not path.exists():
        return []
    return [pair_of(folder, values) for values in json.loads(path.read_text())]


@cache
def open_field(folder: Path, name: str) -> SdfField:
    """The field of a room or an object; opened once."""
    return open_safe_field(folder / f"{name}.safetensors")


@cache
def exact_surface(folder: Path, room: str) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The exact scene's vertices (V, 3), scene frame, and faces (F, 3)."""
    with np.load(folder / f"{room}.surface.npz") as file:
        return file["vertices"], file["faces"]


def pair_of(folder: Path, values: dict[str, Any]) -> Pair:
    """The pair that one entry of such a list describes."""
    box = OrientedBox.from_quaternion(values["detection"]["center"], values["detection"]["size"])
    truth = Sim3.from_dict(values["truth"]["T_object_scene"])
    names = (values["room"], values["object"], values["instance"])
    return Pair(folder, *names, box, truth, values["truth"]["object_diameter"])

"""The golden registrations: few and cheap, on fields that come with the repository or follow from formulas."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from regnf_core import OrientedBox, RegistrationOptions, RegistrationResult, Sim3, open_field, register
from regnf_core.library import LibraryObject, model_object, search_library
from tests.core.analytic import chair, chair_box, chair_pose, room, sphere, table
from tests.core.robust.shapes import (
    UNDER_THE_SEAT,
    observed,
    over_closed,
    random_pose,
    reframed,
    slab_table,
    table_room,
)

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "data"
PAPER = {
    "preset": "paper",
    "sampling": {"pixel_stride": 12},
    "initialization": {"draws": 4},
    "optimization": {"iterations": 60, "samples_per_iteration": 800},
    "resampling": {"max_samples": 2000},
}
"""The published method with fewer rays and iterations: a few seconds."""


@dataclass(frozen=True)
class Case:
    """One golden registration.

    detection: the box that it looks in, by which poses are compared · neural: its fields are networks.
    """

    name: str
    detection: OrientedBox
    run: Callable[[], RegistrationResult]
    neural: bool = False


def cases() -> list[Case]:
    """All golden registrations. Nothing is registered before ``run`` is called."""
    turned_scene, turned_chair, turned_box, _ = reframed(random_pose(1, 1.0), random_pose(2, 0.3))
    box, chair_room = chair_box(chair_pose()), room(chair_pose())
    near = Sim3.from_quaternion(1.02, [0.02, -0.03, 0.04, 1.0], [0.02, -0.01, 0.02]) @ chair_pose()
    return [
        demo("robust-neural-fields"),
        plain("robust-any-orientation", turned_scene, turned_chair, turned_box),
        plain("robust-several-poses", table_room(chair_pose(1.4)), slab_table(), SLAB_BOX),
        plain("robust-wrong-object", chair_room, table(), box),
        plain("robust-seen-in-part", observed(over_closed(UNDER_THE_SEAT), UNDER_THE_SEAT), chair(), box),
        plain("robust-start-and-up-axis", chair_room, chair(), box, {"up_axis": "z"}, near),
        plain("paper-right-object", chair_room, chair(), box, PAPER),
        plain("paper-wrong-object", chair_room, table(), box, PAPER),
        Case("library-search", box, partial(search, chair_room, box)),
    ]


SLAB_BOX = OrientedBox.from_corners([-0.55, -0.5, -0.02], [0.15, 0.2, 0.36])


def plain(
    name: str, scene: Any, obj: Any, box: OrientedBox, options: dict[str, Any] | None = None, start: Sim3 | None = None
) -> Case:
    """A registration of two fields, with seed 1."""
    wanted = RegistrationOptions.from_dict(options or {})
    return Case(name, box, partial(register, scene, obj, box, wanted, seed=1, initial_transform=start, clouds=False))


def demo(name: str) -> Case:
    """The registration of the demo: neural fields."""
    values = json.loads((EXAMPLES / "detection.json").read_text(encoding="utf-8"))
    box = OrientedBox.from_quaternion(values["center"], values["size"], values["rotation_quaternion_xyzw"])
    scene, chair_field = (open_field(EXAMPLES / f"{stem}.safetensors") for stem in ("mix-room", "armchair"))
    return replace(plain(name, scene, chair_field, box), neural=True)


def search(scene: Any, box: OrientedBox) -> RegistrationResult:
    """A search among three objects; the registration of the first."""
    shapes = {"table": table(), "chair": chair(), "ball": sphere(0.4)}
    library = [LibraryObject(name, partial(shapes.__getitem__, name), model_object(shapes[name])) for name in shapes]
    return search_library(scene, box, library, seed=1).result

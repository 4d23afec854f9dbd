"""The four ways to change a scene: substitution, replacement, removal, insertion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Literal, Protocol, runtime_checkable

from torch import Tensor

from regnf_core.editing.request import EditRequest
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField, has_color
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3

# Fields that are made of several: whose matter is at a point.

SCENE_PART = 0
Tint = tuple[float, float, float]
"""sRGB, each 0..1."""


@dataclass(frozen=True, eq=False)
class Part:
    """One of the fields. T_field_scene: from the edited scene's frame to the field's own; None: the same · tint: what
    it is colored with, None: its own colors · name: for people."""

    field: SdfField
    T_field_scene: Sim3 | None
    tint: Tint | None = None
    name: str | None = None

    def color(self, points: Tensor, directions: Tensor) -> Tensor | None:
        """The field's own (N, 3), of points (N, 3) of the scene seen along unit directions (N, 3), if it has any."""
        if not has_color(self.field):
            return None
        if self.T_field_scene is not None:
            places = self.T_field_scene.apply(points.double()).float()
            directions = directions @ self.T_field_scene.rotation.to(directions).T
            return self.field.color(places, directions).to(points)
        return self.field.color(points, directions).to(points)


@runtime_checkable
class PartedField(Protocol):
    """A field that knows which of its parts a point belongs to."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The scene's field, then one field per edit: that of its object, or the scene's for a removal."""
        ...

    def part_at(self, points: Tensor) -> Tensor:
        """(N,) int64, which part's surface is nearest to points (N, 3)."""
        ...

    def signed_distance_and_part(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) at points (N, 3), and which part's surface is nearest (N,) int64."""
        ...


Match = Literal["height", "diagonal"]


def invalid_edit(message: str) -> InvalidInputError:
    """The error for what cannot be done to a scene."""
    return InvalidInputError(message, reason="EDIT_INVALID")


class _Checked:
    """What all edits are refused for. Raises InvalidInputError (INVALID_TRANSFORM, EDIT_INVALID)."""

    def __post_init__(self) -> None:
        for name in ("T_object_scene", "T_replacement_object"):
            transform: Sim3 | None = getattr(self, name, None)
            if transform is None:
                continue
            if transform.scale.shape != ():
                raise InvalidInputError("an edit has one transform, not several", reason="INVALID_TRANSFORM")
            Sim3.from_matrix(transform.matrix())
        residual = getattr(self, "residual", None)
        if residual is not None and not 0.0 <= residual < math.inf:
            raise invalid_edit("residual must be a length in object units, 0 or more")


@dataclass(frozen=True, eq=False)
class Substitution(_Checked):
    """Substitutes the object's own field for the object in the scene, at the pose of a registration.

    T_object_scene: scene to object coordinates · residual: of the registration, in object units (``residual_rms`` times
    the diameter); None: unknown. The larger it is, the farther from the object's surface the scene's surface is
    removed.
    """

    obj: SdfField
    T_object_scene: Sim3
    residual: float | None = None
    tint: Tint | None = None
    name: str | None = None


@dataclass(frozen=True, eq=False)
class Replacement(_Checked):
    """Replaces a registered object by another object.

    obj, T_object_scene, residual: the present object, as in a substitution · replacement: the new object ·
    T_replacement_object: from the object's coordinates to the replacement's; None: same base, upright, same heading and
    same size, along the length that ``match`` selects · up_object, up_replacement: up axis in each one's own frame.
    """

    obj: SdfField
    T_object_scene: Sim3
    replacement: SdfField
    T_replacement_object: Sim3 | None = None
    match: Match = "height"
    up_object: str = "z"
    up_replacement: str = "z"
    residual: float | None = None
    tint: Tint | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.match not in ("height", "diagonal"):
            raise invalid_edit(f"`match` must be height or diagonal, not {str(self.match)[:20]!r}")


@dataclass(frozen=True, eq=False)
class Removal(_Checked):
    """Removes the content of a box. Floor and walls are continued, and surface that extends into the box from outside
    is kept.

    detection: a box around the whole object, scene frame · obj, T_object_scene: the registered object, if it is known:
    its surface then defines what is removed. One of the two is needed.
    """

    detection: OrientedBox | None = None
    obj: SdfField | None = None
    T_object_scene: Sim3 | None = None
    residual: float | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.obj is None) != (self.T_object_scene is None):
            raise invalid_edit("a removal needs both an object and its transform, or neither")
        if self.detection is None and self.obj is None:
            raise invalid_edit("a removal needs a detection, or an object and its transform")


@dataclass(frozen=True, eq=False)
class Insertion(_Checked):
    """Adds an object. Nothing of the scene is removed. T_object_scene: any similarity, scene to object coordinates."""

    obj: SdfField
    T_object_scene: Sim3
    tint: Tint | None = None
    name: str | None = None


Edit = Substitution | Replacement | Removal | Insertion
_EDITS: dict[str, type[Edit]] = {
    "substitution": Substitution, "replacement": Replacement, "removal": Removal, "insertion": Insertion
}  # fmt: skip


def open_edits(requests: Sequence[EditRequest], open_object: Callable[[str], SdfField]) -> list[Edit]:
    """A request's edits, with names, as edits with fields, in the same order; ``open_object`` opens each named field
    once. Raises what it raises."""
    opened = cache(open_object)
    read: dict[str, Callable[[Any], Any]] = {
        "object": opened,
        "replacement": opened,
        "detection": OrientedBox.from_detection,
        "T_object_scene": Sim3.from_matrix,
        "T_replacement_object": Sim3.from_matrix,
    }
    edits = []
    for request in requests:
        said = {each.name: getattr(request, each.name) for each in fields(request)}
        made = {n: read[n](value) if n in read and value is not None else value for n, value in said.items()}
        edits.append(_EDITS[made.pop("kind")](obj=made.pop("object"), **made))
    return edits

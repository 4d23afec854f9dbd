"""The four ways to change a scene: substitution, replacement, removal, insertion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from torch import Tensor

from regnf_core.detections import Detection
from regnf_core.editing.request import (
    EditRequest,
    InsertionRequest,
    RemovalRequest,
    ReplacementRequest,
    SubstitutionRequest,
)
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField
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


@runtime_checkable
class PartedField(Protocol):
    """A field that knows which of its parts a point belongs to."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The scene, then an edit's object each; an edit that has none (a removal) has the scene's field."""
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


def _checked(transform: Sim3) -> None:
    """Raises InvalidInputError (INVALID_TRANSFORM) for what is no single similarity of float64 numbers."""
    if transform.scale.shape != ():
        raise InvalidInputError("an edit has one transform, not a batch", reason="INVALID_TRANSFORM")
    Sim3.from_matrix(transform.matrix())


def _check_residual(residual: float | None) -> None:
    if residual is not None and not 0.0 <= residual < math.inf:
        raise invalid_edit("a residual is a length in object units, 0 or more")


@dataclass(frozen=True, eq=False)
class Substitution:
    """The object's own field where the scene shows the object: as a registration has found it.

    T_object_scene: scene to object coordinates · residual: of the registration, in object units (``residual_rms`` times
    the diameter); None: unknown. The larger it is, the farther from the object's surface the scene's copy is removed.
    """

    obj: SdfField
    T_object_scene: Sim3
    residual: float | None = None
    tint: Tint | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        _checked(self.T_object_scene)
        _check_residual(self.residual)


@dataclass(frozen=True, eq=False)
class Replacement:
    """Another object in place of one that was registered.

    obj, T_object_scene, residual: as in a substitution, of what stands there now · replacement: what will
    stand there · T_replacement_object: the known pose of both, from the object's coordinates to the replacement's;
    None: it stands on the same base, upright, turned alike, and is as large: ``match`` says along which length ·
    up_object, up_replacement: the vertical in each one's own frame.
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
        for transform in (self.T_object_scene, self.T_replacement_object):
            if transform is not None:
                _checked(transform)
        _check_residual(self.residual)
        if self.match not in ("height", "diagonal"):
            raise invalid_edit(f"a replacement matches height or diagonal, not {str(self.match)[:20]!r}")


@dataclass(frozen=True, eq=False)
class Removal:
    """What stands in a box is taken away; floor and walls go on, and what reaches in from outside stays.

    detection: all of the thing, scene frame · obj, T_object_scene: what was registered there, where it is known: then
    its surface says what belongs to the thing. One of the two is needed.
    """

    detection: OrientedBox | None = None
    obj: SdfField | None = None
    T_object_scene: Sim3 | None = None
    residual: float | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if (self.obj is None) != (self.T_object_scene is None):
            raise invalid_edit("a removal has an object and its transform, or neither")
        if self.detection is None and self.obj is None:
            raise invalid_edit("a removal needs a detection, or an object and its transform")
        _check_residual(self.residual)
        if self.T_object_scene is not None:
            _checked(self.T_object_scene)


@dataclass(frozen=True, eq=False)
class Insertion:
    """An object where nothing of the scene is removed. T_object_scene: any similarity, scene to object coordinates."""

    obj: SdfField
    T_object_scene: Sim3
    tint: Tint | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        _checked(self.T_object_scene)


Edit = Substitution | Replacement | Removal | Insertion


# From a request's edits, with names, to edits with fields.


def open_edits(requests: Sequence[EditRequest], open_object: Callable[[str], SdfField]) -> list[Edit]:
    """The edits in the same order; ``open_object`` opens each named field once. Raises what it raises."""
    opened: dict[str, SdfField] = {}

    def field(name: str) -> SdfField:
        if name not in opened:
            opened[name] = open_object(name)
        return opened[name]

    return [_opened(request, field) for request in requests]


def _opened(request: EditRequest, field: Callable[[str], SdfField]) -> Edit:
    match request:
        case SubstitutionRequest():
            return Substitution(field(request.object), _transform(request.T_object_scene), **_common(request))
        case ReplacementRequest():
            known = request.T_replacement_object
            return Replacement(
                field(request.object),
                _transform(request.T_object_scene),
                field(request.replacement),
                None if known is None else _transform(known),
                request.match,
                request.up_object,
                request.up_replacement,
                **_common(request),
            )
        case RemovalRequest():
            known = request.T_object_scene
            return Removal(
                _box(request.detection),
                None if request.object is None else field(request.object),
                None if known is None else _transform(known),
                request.residual,
                request.name,
            )
        case InsertionRequest():
            placed = _transform(request.T_object_scene)
            return Insertion(field(request.object), placed, request.tint, request.name)


def _common(request: SubstitutionRequest | ReplacementRequest) -> dict[str, Any]:
    return {"residual": request.residual, "tint": request.tint, "name": request.name}


def _transform(rows: list[list[float]]) -> Sim3:
    return Sim3.from_matrix(rows)


def _box(detection: Detection | None) -> OrientedBox | None:
    return None if detection is None else OrientedBox.from_detection(detection)

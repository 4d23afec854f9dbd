"""A scene and its edits as one field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from regnf_core.editing.clearing import Clearing, clear_box, clear_thing
from regnf_core.editing.edited_scene import EditedScene
from regnf_core.editing.edits import Edit, Insertion, Removal, Replacement, Substitution
from regnf_core.editing.observed import observation_after
from regnf_core.editing.overlap import Occupied, require_apart
from regnf_core.editing.parts import Part, PartedField, Tint
from regnf_core.editing.placed_object import PlacedObject
from regnf_core.editing.standing import standing_alike
from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.fields.base import SdfField
from regnf_core.fields.observation import observation_of
from regnf_core.fields.transformed import near_origin
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.surface.surface_bounds import surface_bounds


@dataclass(frozen=True, eq=False)
class _Planned:
    """What an edit comes to. removed: the known thing that goes, or a box · placed: what comes."""

    removed: PlacedObject | OrientedBox | None
    placed: PlacedObject | None
    residual: float = 0.0
    tint: Tint | None = None
    name: str | None = None

    @property
    def place(self) -> OrientedBox:
        """The box of what comes, or else of what goes."""
        thing = self.placed or self.removed
        assert thing is not None
        return thing.box if isinstance(thing, PlacedObject) else thing


def compose(
    scene: SdfField, edits: Sequence[Edit], seed: int = 0, progress: Callable[[float], None] | None = None
) -> EditedScene:
    """The scene with all edits done, a field as any other: it can be registered against, rendered and edited again.

    Distances are in scene units. Deterministic for a seed. ``progress`` is called with the share done, 0..1, before
    each edit; it may raise CancelledError to stop the work.
    Raises InvalidInputError: INVALID_TRANSFORM, EDIT_INVALID, EDITS_OVERLAP (two edits change the same place),
    EDIT_OUTSIDE_SCENE, FIELD_NOT_FINITE; and NoSurfaceError (NO_SURFACE_IN_OBJECT).
    """
    surfaces: dict[int, OrientedBox] = {}
    scene, origin = near_origin(scene)
    planned = [_planned(_moved(edit, origin), number, surfaces) for number, edit in enumerate(edits)]
    for number, plan in enumerate(planned):
        _require_in_scene(scene, plan, number)
    require_apart([Occupied(plan.removed, plan.placed) for plan in planned])
    before = scene.parts if isinstance(scene, PartedField) else (Part(scene, None),)
    clearings: list[Clearing] = []
    objects: list[tuple[int, PlacedObject]] = []
    parts = list(before)
    for number, plan in enumerate(planned):
        if progress is not None:
            progress(number / len(planned))
        generator = torch.Generator().manual_seed(seed + number)
        if isinstance(plan.removed, PlacedObject):
            clearings.append(clear_thing(scene, plan.removed, plan.residual, generator))
        elif plan.removed is not None:
            clearings.append(clear_box(scene, plan.removed, generator))
        if plan.placed is not None:
            objects.append((len(parts), plan.placed))
            parts.append(Part(plan.placed.obj, plan.placed.T_object_scene, plan.tint, plan.name))
        else:
            parts.append(replace(before[0], name=plan.name))
    places = [plan.place for plan in planned]
    known = observation_of(scene)
    if known is not None:
        known = observation_after(known, EditedScene(scene, clearings, objects, parts, places))
    return EditedScene(scene, clearings, objects, parts, places, known, origin)


def _moved(edit: Edit, origin: Tensor) -> Edit:
    """The edit of a scene from all of whose places ``origin`` (3,) was subtracted."""
    if not origin.any():
        return edit
    T = None if edit.T_object_scene is None else edit.T_object_scene @ Sim3.from_translation(origin)
    if isinstance(edit, Removal):
        box = None if edit.detection is None else edit.detection.shifted(-origin)
        return replace(edit, detection=box, T_object_scene=T)
    assert T is not None
    return replace(edit, T_object_scene=T)


def _planned(edit: Edit, number: int, surfaces: dict[int, OrientedBox]) -> _Planned:
    try:
        match edit:
            case Substitution():
                thing = _placed(edit.obj, edit.T_object_scene, surfaces)
                return _Planned(thing, thing, _scene_units(edit.residual, thing), edit.tint, edit.name)
            case Replacement():
                thing = _placed(edit.obj, edit.T_object_scene, surfaces)
                here, other = (_surface(field, surfaces) for field in (edit.obj, edit.replacement))
                T_other_thing = edit.T_replacement_object
                if T_other_thing is None:
                    verticals = edit.up_object, edit.up_replacement
                    T_other_thing = standing_alike(here, other, *verticals, edit.match)
                placed = PlacedObject(edit.replacement, T_other_thing @ edit.T_object_scene, other)
                return _Planned(thing, placed, _scene_units(edit.residual, thing), edit.tint, edit.name)
            case Removal():
                if edit.obj is None or edit.T_object_scene is None:
                    return _Planned(edit.detection, None, name=edit.name)
                thing = _placed(edit.obj, edit.T_object_scene, surfaces)
                return _Planned(thing, None, _scene_units(edit.residual, thing), name=edit.name)
            case Insertion():
                return _Planned(None, _placed(edit.obj, edit.T_object_scene, surfaces), tint=edit.tint, name=edit.name)
    except NoSurfaceError as error:
        raise NoSurfaceError(f"edit {number}: {error}", reason=error.reason) from error


def _placed(field: SdfField, T_object_scene: Sim3, surfaces: dict[int, OrientedBox]) -> PlacedObject:
    return PlacedObject(field, T_object_scene, _surface(field, surfaces))


def _surface(field: SdfField, surfaces: dict[int, OrientedBox]) -> OrientedBox:
    """The box of a field's surface, found once a field."""
    if id(field) not in surfaces:
        surfaces[id(field)] = surface_bounds(field)
    return surfaces[id(field)]


def _scene_units(residual: float | None, thing: PlacedObject) -> float:
    return (residual or 0.0) / thing.scale


def _require_in_scene(scene: SdfField, plan: _Planned, number: int) -> None:
    """Raises InvalidInputError (EDIT_OUTSIDE_SCENE): nothing of the thing lies within the scene's bounds."""
    low, high = scene.bounds
    for thing in (plan.removed, plan.placed):
        box = thing.box if isinstance(thing, PlacedObject) else thing
        if box is None:
            continue
        corners = box.corners()
        if bool((corners.amin(0) > high).any()) or bool((corners.amax(0) < low).any()):
            message = f"edit {number}: what it changes lies outside of the scene's bounds"
            hint = "T_object_scene takes scene coordinates to object coordinates. Check its direction and the units."
            raise InvalidInputError(message, reason="EDIT_OUTSIDE_SCENE", hint=hint)

"""A scene and its edits as one field."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from regnf_core.editing.clearing import Clearing, Place, clear
from regnf_core.editing.edited_scene import EditedScene
from regnf_core.editing.edits import (
    Edit,
    Insertion,
    Match,
    Part,
    PartedField,
    Removal,
    Replacement,
    Substitution,
    Tint,
    invalid_edit,
)
from regnf_core.editing.support import PlacedObject
from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import Observation, SdfField, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.description import FREE, SURFACE, UNSEEN
from regnf_core.surface.sphere_tracing import axis_vector, surface_bounds

# What counts as observed after the edits: there, everything does.


def observation_after(known: Observation, edited: EditedScene) -> Observation:
    """``known`` with the voxels of cleared places and of objects told from the edited scene: surface, free, or within
    matter, which nobody sees."""
    states = known.states.clone()
    boxes = [clearing.box for clearing in edited.clearings if isinstance(clearing, Clearing)]
    boxes += [thing.box for _, thing in edited.objects]
    for box in boxes:
        index = _voxels_of(known, box)
        if not len(index):
            continue
        points = _middles(known, index)
        distance = edited.signed_distance(points.float()).double().cpu()
        voxel = known.voxel if known.T_grid_frame is None else known.voxel / float(known.T_grid_frame.scale)
        state = torch.where(distance > 0, FREE, UNSEEN)
        state = torch.where(distance.abs() <= 0.5 * 3**0.5 * voxel, SURFACE, state).to(states.dtype)
        x, y, z = index.unbind(-1)
        states[x, y, z] = state
    return replace(known, states=states)


def _voxels_of(known: Observation, box: OrientedBox) -> Tensor:
    """(M, 3) int64, the voxels whose middles lie in ``box`` of the scene's frame."""
    corners = box.corners()
    if known.T_grid_frame is not None:
        corners = known.T_grid_frame.apply(corners)
    cells = (corners - known.low) / known.voxel
    low = cells.amin(0).floor().long().clamp_min(0)
    high = torch.minimum(cells.amax(0).ceil().long(), torch.tensor(known.states.shape))
    if bool((high <= low).any()):
        return torch.zeros(0, 3, dtype=torch.int64)
    index = torch.cartesian_prod(*(torch.arange(int(a), int(b)) for a, b in zip(low, high, strict=True)))
    return index[box.contains(_middles(known, index))]


def _middles(known: Observation, index: Tensor) -> Tensor:
    """(M, 3) float64, the voxels' middles in the scene's frame."""
    points = known.low + known.voxel * (index.double() + 0.5)
    return points if known.T_grid_frame is None else known.T_grid_frame.apply_inverse(points)


@dataclass(frozen=True, eq=False)
class _Planned:
    """What an edit comes to. removed: the known object that goes, or a box · placed: what comes."""

    removed: Place | None
    placed: PlacedObject | None
    residual: float = 0.0
    tint: Tint | None = None
    name: str | None = None

    @property
    def place(self) -> OrientedBox:
        """The box of what comes, or else of what goes."""
        thing = self.placed or self.removed
        assert thing is not None
        return _box_of(thing)


# Edits of one scene must not meddle with each other: each changes a place of its own.

_POINTS = 12
"""Along each edge of a box, to tell how much of two solids is common."""
_MOST_COMMON = 0.05
"""Share of the smaller of two objects' matter that may lie in the other: things touch, and poses are not exact."""
_MOST_OF_BOX = 0.5
"""Share of an object's matter that may lie in a box that another edit clears."""


def _require_apart(edits: Sequence[_Planned]) -> None:
    """Raises InvalidInputError (EDIT_INVALID): two edits take away the same object, or put matter in one place."""
    for (first, one), (second, other) in combinations(enumerate(edits), 2):
        for a, b in ((one.removed, other.removed), (one.placed, other.placed)):
            if a is None or b is None:
                continue
            most = _MOST_COMMON if isinstance(a, PlacedObject) and isinstance(b, PlacedObject) else _MOST_OF_BOX
            if _common(a, b) > most:
                message = f"edits {first} and {second} change the same place"
                hint = "Leave one of them out, or apply one after the other: an edited scene can be edited again."
                raise InvalidInputError(message, reason="EDIT_INVALID", hint=hint)


def _common(a: Place, b: Place) -> float:
    """The larger of the shares of each one's matter that lies in the other."""
    one, other = _box_of(a), _box_of(b)
    if float((one.center - other.center).norm()) > 0.5 * (one.diagonal + other.diagonal):
        return 0.0
    return max(_share_within(a, b), _share_within(b, a))


def _share_within(a: Place, b: Place) -> float:
    box = _box_of(a)
    steps = (torch.arange(_POINTS, dtype=torch.float64) + 0.5) / _POINTS - 0.5
    points = (box.center + (torch.cartesian_prod(steps, steps, steps) * box.size) @ box.rotation.T).float()
    if isinstance(a, PlacedObject):
        distance = a.signed_distance(points).cpu()
        thin = float((box.size / _POINTS).norm()) / 2.0  # legs and plates fall between the points
        points = points[distance < (0.0 if int((distance < 0).sum()) >= _POINTS else thin)]
    if not len(points):
        return 0.0
    within = b.contains(points) if isinstance(b, OrientedBox) else b.signed_distance(points).cpu() < 0.0
    return float(within.float().mean())


def _box_of(place: Place) -> OrientedBox:
    return place.box if isinstance(place, PlacedObject) else place


# Where a replacement stands: on the base of what stood there, upright, turned alike, as large.


def standing_alike(
    here: OrientedBox, replacement: OrientedBox, up_here: str, up_replacement: str, match: Match = "height"
) -> Sim3:
    """T_replacement_object: the middles of both bases coincide, and so do the verticals.

    here, replacement: the boxes of both surfaces, each in its own frame, axis-aligned · match: which length becomes
    equal, that along the vertical or that of the boxes' diagonals. Both keep their heading: the axis that follows the
    vertical in the order x, y, z, x is taken to mean the same in both. Raises InvalidInputError (EDIT_INVALID).
    """
    frames = [_upright(up_here), _upright(up_replacement)]
    sizes = [frame.abs().T @ box.size for frame, box in zip(frames, (here, replacement), strict=True)]
    lengths = [float(size[2] if match == "height" else size.norm()) for size in sizes]
    scale = torch.tensor(lengths[1] / lengths[0], dtype=torch.float64)
    bases = [
        box.center - frame[:, 2] * size[2] / 2.0
        for box, frame, size in zip((here, replacement), frames, sizes, strict=True)
    ]
    rotation = frames[1] @ frames[0].T
    return Sim3(scale, rotation, bases[1] - scale * (rotation @ bases[0]))


def _upright(up: str) -> Tensor:
    """(3, 3), columns: two level axes and the vertical, right-handed."""
    if up.removeprefix("-") not in ("x", "y", "z"):
        raise invalid_edit(f"the up axis must be x, y, z, -x, -y or -z, not {up[:20]!r}")
    sign = -1.0 if up.startswith("-") else 1.0
    first = axis_vector("xyz"[("xyz".index(up[-1]) + 1) % 3])
    vertical = sign * axis_vector(up[-1])
    return torch.stack([first, torch.linalg.cross(vertical, first), vertical], dim=1)


def compose(
    scene: SdfField, edits: Sequence[Edit], seed: int = 0, progress: Callable[[float], None] | None = None
) -> EditedScene:
    """Apply all edits to a scene. The result is a field: it can be the scene of a registration, be rendered and be
    edited again.

    Distances are in scene units. Deterministic for a seed. ``progress`` is called with the progress, 0..1, before each
    edit. It may raise CancelledError to stop the work.
    Raises InvalidInputError: INVALID_TRANSFORM, EDIT_INVALID (also for two edits of one place, and beyond the scene),
    FIELD_NOT_FINITE; and NoSurfaceError (NO_SURFACE_IN_OBJECT).
    """
    surfaces: dict[int, OrientedBox] = {}
    scene, origin = near_origin(scene)
    planned = [_planned(_moved(edit, origin), number, surfaces) for number, edit in enumerate(edits)]
    for number, plan in enumerate(planned):
        _require_in_scene(scene, plan, number)
    _require_apart(planned)
    before = scene.parts if isinstance(scene, PartedField) else (Part(scene, None),)
    clearings: list[Clearing] = []
    objects: list[tuple[int, PlacedObject]] = []
    parts = list(before)
    for number, plan in enumerate(planned):
        if progress is not None:
            progress(number / len(planned))
        generator = torch.Generator().manual_seed(seed + number)
        if plan.removed is not None:
            clearings.append(clear(scene, plan.removed, plan.residual, generator))
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
    """surfaces: the boxes of fields' surfaces by the fields' ids, each found once."""

    def surface(field: SdfField) -> OrientedBox:
        if id(field) not in surfaces:
            surfaces[id(field)] = surface_bounds(field)
        return surfaces[id(field)]

    tint = None if isinstance(edit, Removal) else edit.tint
    try:
        if edit.obj is None or edit.T_object_scene is None:
            return _Planned(edit.detection, None, name=edit.name)
        thing = PlacedObject(edit.obj, edit.T_object_scene, surface(edit.obj))
        if isinstance(edit, Insertion):
            return _Planned(None, thing, tint=tint, name=edit.name)
        placed = thing if isinstance(edit, Substitution) else None
        if isinstance(edit, Replacement):
            other, T_other_thing = surface(edit.replacement), edit.T_replacement_object
            if T_other_thing is None:
                T_other_thing = standing_alike(thing.surface, other, edit.up_object, edit.up_replacement, edit.match)
            placed = PlacedObject(edit.replacement, T_other_thing @ edit.T_object_scene, other)
        return _Planned(thing, placed, (edit.residual or 0.0) / thing.scale, tint, edit.name)
    except NoSurfaceError as error:
        raise NoSurfaceError(f"edit {number}: {error}", reason=error.reason) from error


def _require_in_scene(scene: SdfField, plan: _Planned, number: int) -> None:
    """Raises InvalidInputError (EDIT_INVALID): nothing of the object lies within the scene's bounds."""
    low, high = scene.bounds
    for thing in (plan.removed, plan.placed):
        if thing is None:
            continue
        corners = _box_of(thing).corners()
        if bool((corners.amin(0) > high).any()) or bool((corners.amax(0) < low).any()):
            message = f"edit {number}: it changes a place outside of the scene's bounds"
            hint = "T_object_scene maps scene coordinates to object coordinates. Check its direction and the units."
            raise InvalidInputError(message, reason="EDIT_INVALID", hint=hint)

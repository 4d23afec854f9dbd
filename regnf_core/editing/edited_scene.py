"""An edited scene as a field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from regnf_core.editing.clearing import Clearing, RegionGrid, Unseen
from regnf_core.editing.edits import SCENE_PART, Part, PartedField
from regnf_core.editing.support import PlacedObject
from regnf_core.fields.composite import near_origin
from regnf_core.fields.observation import Observation, SdfField, has_color, inverse_deviation_of, observation_of
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.schema.description import SURFACE

_PLAIN = 0.8
"""Color of a part that has none, where another has."""
_SAME_SURFACE = 0.004
"""Of the box's diagonal: a surface of the scene that lies no farther from the object's counts as a part of it."""


@dataclass
class _Found:
    """At N points: distance (N,), gradient (N, 3), part (N,)."""

    distance: Tensor
    gradient: Tensor
    part: Tensor

    @classmethod
    def nothing_at(cls, points: Tensor) -> _Found:
        distance = torch.zeros_like(points[:, 0])
        return cls(distance, torch.zeros_like(points), torch.full_like(distance, SCENE_PART, dtype=torch.int64))

    def at(self, index: Tensor) -> _Found:
        return _Found(self.distance[index], self.gradient[index], self.part[index])

    def enter(self, index: Tensor, values: _Found) -> None:
        self.distance[index], self.gradient[index], self.part[index] = values.distance, values.gradient, values.part


class EditedScene:
    """The scene less what was cleared, and the objects: as solids, so the smallest distance counts.

    clearings: places that the edits clear · objects: each with the number of its part · parts: the scene's, then one an
    edit · places: the box of each edit's thing · observation: of the edited scene; None where the scene has none ·
    origin: (3,) float64, where the frame of all these begins in that of the field: single precision is enough in the
    former alone. Made by ``compose``.
    """

    def __init__(
        self,
        scene: SdfField,
        clearings: Sequence[Clearing | Unseen],
        objects: Sequence[tuple[int, PlacedObject]],
        parts: Sequence[Part],
        places: Sequence[OrientedBox] = (),
        observation: Observation | None = None,
        origin: Tensor | None = None,
    ) -> None:
        self.scene = scene
        self.clearings = tuple(clearings)
        self.objects = tuple(objects)
        self._parts = tuple(parts)
        self._places = tuple(places)
        self._observation = observation
        self.origin = torch.zeros(3, dtype=torch.float64) if origin is None else origin
        if any(has_color(part.field) for part in parts):
            self.color = self._color

    def moved(self, shift: Tensor) -> EditedScene:
        """The same where ``shift`` (3,) is subtracted from all places."""
        origin, same = self.origin - shift, (self._places, self._observation)
        return EditedScene(self.scene, self.clearings, self.objects, self._parts, *same, origin)

    @property
    def parts(self) -> tuple[Part, ...]:
        """The scene's, then one an edit."""
        if not self.origin.any():
            return self._parts
        shift = Sim3.from_translation(-self.origin)
        moved = (shift if part.T_field_scene is None else part.T_field_scene @ shift for part in self._parts)
        return tuple(replace(part, T_field_scene=T) for part, T in zip(self._parts, moved, strict=True))

    @property
    def places(self) -> tuple[OrientedBox, ...]:
        """The box of each edit's object."""
        return tuple(box.shifted(self.origin) for box in self._places)

    @property
    def observation(self) -> Observation | None:
        if self._observation is None or not self.origin.any():
            return self._observation
        return self._observation.seen_in(Sim3.from_translation(-self.origin))

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float64 on the CPU: the scene's, and what objects reach beyond them."""
        boxes = torch.stack([self.scene.bounds, *(thing.bounds for _, thing in self.objects)])
        return torch.stack([boxes[:, 0].amin(0), boxes[:, 1].amax(0)]) + self.origin

    @property
    def device(self) -> torch.device:
        return self.scene.device

    @property
    def inverse_deviation(self) -> float | None:
        """The scene's own."""
        return inverse_deviation_of(self.scene)

    def to(self, device: torch.device | str) -> EditedScene:
        """The same with all parameters on another device."""
        moved = [(number, thing.to(device)) for number, thing in self.objects]
        parts = [replace(part, field=part.field.to(device)) for part in self._parts]
        same = self._places, self._observation, self.origin
        return EditedScene(self.scene.to(device), self.clearings, moved, parts, *same)

    def _near(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the field's frame in that of its parts, single precision."""
        return (points.to(self.device).double() - self.origin.to(self.device)).float()

    @torch.no_grad()
    def signed_distance(self, points: Tensor) -> Tensor:
        """Signed distance (N,) float32 at points (N, 3), scene units."""
        return self._evaluate(points, False)[0]

    @torch.no_grad()
    def signed_distance_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and its gradient (N, 3) at points (N, 3)."""
        return self._evaluate(points, True)[:2]

    def part_at(self, points: Tensor) -> Tensor:
        """(N,) int64, which part is nearest to points (N, 3)."""
        return self.signed_distance_and_part(points)[1]

    @torch.no_grad()
    def signed_distance_and_part(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (N,) and the nearest part (N,) int64 at points (N, 3)."""
        distance, _, part = self._evaluate(points, False)
        if isinstance(self.scene, PartedField):
            own = (part == SCENE_PART).nonzero().squeeze(-1)
            part[own] = self.scene.part_at(self._near(points)[own])
        return distance, part

    def _evaluate(self, points: Tensor, with_gradient: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Distance (N,), gradient (N, 3), 0 unless it is requested, and part (N,) at points (N, 3)."""
        points = self._near(points)
        asked = torch.ones(len(points), dtype=torch.bool, device=points.device)
        found = _Found.nothing_at(points)
        if self.clearings:
            inside = torch.stack([clearing.reaches(points) < 0.0 for clearing in self.clearings]).any(0)
            within = inside.nonzero().squeeze(-1)
            without_scene, decided = self._without_scene(points[within], with_gradient)
            found.enter(within[decided], without_scene.at(decided))
            asked[within[decided]] = False
        rest = asked.nonzero().squeeze(-1)
        found.enter(rest, self._with_scene(points[rest], with_gradient))
        return found.distance, found.gradient, found.part

    def _without_scene(self, points: Tensor, with_gradient: bool) -> tuple[_Found, Tensor]:
        """What is at points (N, 3) if the scene's own distance does not count, and whether it does not (N,).

        With no matter of the scene anywhere near, and with nothing but it: where objects and continued ground are
        nearer than the second of these, the result is the same for all distances of the scene.
        """
        empty, full = _Found.nothing_at(points), _Found.nothing_at(points)
        empty.distance.fill_(torch.inf)
        full.distance.fill_(-torch.inf)
        for clearing in self.clearings:
            limits = clearing.limits(points, with_gradient)
            for bound in (empty, full):
                bound.distance, bound.gradient = limits.apply((bound.distance, bound.gradient))
        self._add_objects(empty, points, full.distance.clamp_min(0.0), with_gradient)
        return empty, empty.distance <= full.distance

    def _with_scene(self, points: Tensor, with_gradient: bool) -> _Found:
        found = _Found.nothing_at(points)
        if with_gradient:
            distance, gradient = self.scene.signed_distance_and_gradient(points)
            found.gradient = gradient.to(points)
        else:
            distance = self.scene.signed_distance(points)
        found.distance = distance.to(points)
        for clearing in self.clearings:
            near = (clearing.reaches(points) < found.distance.abs()).nonzero().squeeze(-1)
            limits = clearing.limits(points[near], with_gradient)
            found.distance[near], found.gradient[near] = limits.apply((found.distance[near], found.gradient[near]))
        self._add_objects(found, points, found.distance.clamp_min(0.0), with_gradient)
        return found

    def _add_objects(self, found: _Found, points: Tensor, reach: Tensor, with_gradient: bool) -> None:
        """Join the objects whose boxes are no farther from points (N, 3) than ``reach`` (N,)."""
        for number, thing in self.objects:
            near = (thing.distance_to_box(points) <= reach).nonzero().squeeze(-1)
            if with_gradient:
                here, slope = thing.signed_distance_and_gradient(points[near])
            else:
                here, slope = thing.signed_distance(points[near]), found.gradient[near]
            before = found.distance[near]
            nearer = here < before
            parts = torch.full_like(near[nearer], number)
            found.enter(near[nearer], _Found(here[nearer], slope[nearer], parts))
            # Where the scene kept a rim of its own copy, round what stands on the object, it is the object's surface.
            rim = (here < before + _SAME_SURFACE * thing.box.diagonal) & (found.part[near] == SCENE_PART)
            found.part[near[rim]] = number

    @torch.no_grad()
    def _color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Color (N, 3) of points (N, 3) seen along unit directions (N, 3): that of the nearest part."""
        numbers, points = self.part_at(points), self._near(points)
        directions = directions.to(points)
        colors = torch.full_like(points, _PLAIN)
        for number in torch.unique(numbers).tolist():
            chosen = (numbers == number).nonzero().squeeze(-1)
            own = self._parts[number].color(points[chosen], directions[chosen])
            if own is not None:
                colors[chosen] = own
        return colors


# A scene without unobserved matter: networks invent it behind objects, and it blocks cameras there.

_AROUND = 2
"""Voxels round measured surface whose matter stays."""


def without_unseen(scene: SdfField) -> SdfField:
    """The scene without unobserved matter; itself where it does not know what was observed."""
    near, origin = near_origin(scene)
    known = observation_of(near)
    if known is None:
        return scene
    shape = torch.tensor(known.states.shape, dtype=torch.float64)
    box = OrientedBox(known.low + known.voxel * shape / 2, known.voxel * shape, torch.eye(3, dtype=torch.float64))
    cell = known.voxel
    if known.T_grid_frame is not None:
        back = known.T_grid_frame.inverse()
        box = OrientedBox(back.apply(box.center[None])[0], box.size * back.scale, back.rotation)
        cell = cell * float(back.scale)
    x, y, z = known.states.shape
    measured = np.asarray(binary_dilation((known.states == SURFACE).numpy(), iterations=_AROUND))
    shell = RegionGrid(box, cell, (x, y, z)).distance_to(measured)
    return EditedScene(near, [Unseen(shell)], [], [Part(near, None)], (), known, origin)

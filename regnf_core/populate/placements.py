"""Objects of a library at places of a scene: searched at each proposal, confirmed in a box of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from regnf_core.errors import InvalidDetectionError, NoSurfaceError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject, refined_objects
from regnf_core.options import RegistrationOptions
from regnf_core.populate.proposals import Integers, SceneSurface
from regnf_core.progress import Run
from regnf_core.robust.model import ObjectModel
from regnf_core.robust.scene import view_scene

_WORTH = 0.2
"""Probability from which on a pose is looked at again, in a box of its own."""
_TOLERANCE = 1.5
"""Spacings: how far from an object's surface it explains the scene's."""
_ROOM = 1.08
"""How much larger than the placed object its own box is."""


@dataclass(frozen=True, eq=False)
class Placement:
    """number: of the object in the library · probability: of the pose by itself · explains: numbers of the scene's
    samples that lie on the object."""

    number: int
    T_object_scene: Sim3
    probability: float
    verdict: str
    reason: str
    explains: Integers
    alternatives: tuple[Sim3, ...] = ()


def box_of_pose(model: ObjectModel, T_object_scene: Sim3, room: float = _ROOM) -> OrientedBox:
    """The object's own box where the pose puts it, a little larger; scene frame."""
    low, high = model.bounds
    back = T_object_scene.inverse()
    center = back.apply(((low + high) / 2)[None])[0]
    size = (high - low) * float(back.scale)
    return OrientedBox(center, size * room + 0.02 * size.norm(), back.rotation)


def explained(surface: SceneSurface, obj: SdfField, model: ObjectModel, T_object_scene: Sim3) -> Integers:
    """Numbers of the samples of the scene's surface that lie on the placed object's."""
    tolerance = max(_TOLERANCE * surface.spacing * float(T_object_scene.scale), 0.01 * model.frame.length)
    moved = T_object_scene.apply(torch.from_numpy(surface.points))
    low, high = model.bounds
    near = ((moved >= low - tolerance) & (moved <= high + tolerance)).all(-1).nonzero()[:, 0]
    if not len(near):
        return np.zeros(0, np.int64)
    distance, gradient = obj.signed_distance_and_gradient(moved[near].float())
    normals = torch.from_numpy(surface.normals)[near] @ T_object_scene.rotation.mT
    alike = (normals * gradient.double()).sum(-1) > 0.3 * gradient.double().norm(dim=-1)
    found: Integers = near[(distance.abs().cpu() <= tolerance) & alike.cpu()].numpy()
    return found


@dataclass(frozen=True, eq=False)
class Seeker:
    """What finds an object at a proposal."""

    scene: SdfField
    surface: SceneSurface
    library: Sequence[LibraryObject]
    options: RegistrationOptions
    seed: int

    def best_in(self, box: OrientedBox) -> Placement | None:
        """The library's most probable object in the box, whatever its verdict."""
        try:
            view = view_scene(self.scene, box, self.options.robust)
        except (NoSurfaceError, InvalidDetectionError):
            return None
        numbers = self._fitting(box)
        if not numbers:
            return None
        some = [self.library[number] for number in numbers]
        _, _, refined, _ = refined_objects(self.scene, view, some, self.options, self.seed, Run(None))
        evaluation, number, _, _ = refined[0]
        number = numbers[number]
        found, one = evaluation.found, self.library[number]
        explains = explained(self.surface, one.field(), one.model, evaluation.T)
        alternatives = tuple(other.T_object_scene for other in evaluation.alternatives)
        likely = evaluation.metrics["probability"]
        return Placement(number, evaluation.T, likely, found.verdict, found.reason, explains, alternatives)

    def at(self, box: OrientedBox) -> Placement | None:
        """The object in a box, confirmed in a box of its own; None: nothing is probable."""
        first = self.best_in(box)
        if first is None or first.probability < _WORTH:
            return None
        return self.best_in(box_of_pose(self.library[first.number].model, first.T_object_scene))

    def _fitting(self, box: OrientedBox) -> list[int]:
        """Numbers of the objects that may have the size of the box, where the scale is known."""
        low, high = self.options.robust.scale_range
        if low is None or high is None:
            return list(range(len(self.library)))
        kept = []
        for number, one in enumerate(self.library):
            across = one.model.frame.length
            if across / high <= 1.5 * box.diagonal and across / low >= 0.4 * box.diagonal:
                kept.append(number)
        return kept

"""Objects of a library at places of a scene: searched in a proposal's box, confirmed in a box of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from regnf_core.document import Verdict
from regnf_core.errors import InvalidDetectionError, NoSurfaceError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject, refined_objects
from regnf_core.options import RegistrationOptions
from regnf_core.population.proposals import Integers, SceneSurface
from regnf_core.progress import Run
from regnf_core.robust.model import ObjectModel
from regnf_core.robust.scene import view_scene

_WORTH = 0.2
"""Probability from which on a pose is looked at again, in a box of its own."""
_WORST = 0.65
"""Score of the coarse search, 0..1, above which a box is given up: of boxes with a likely pose none has more."""
_SHORTLIST = 24
"""Objects that are searched coarsely in a box: a proposal shows less of an object than a detection's box."""
_TOLERANCE, _LEAST_TOLERANCE = 1.5, 0.01
"""How far from an object's surface it explains the scene's: spacings; object diameters, at least."""
_ALIKE = 0.3
"""Least cosine between the normals of both."""
_LARGER, _MARGIN = 1.08, 0.02
"""An object's own box: over the object's size, and further, of its diagonal."""
_FITTING = (0.4, 1.5)
"""Object diameters over the diagonal of a box in which it may stand, where the scale is known."""


@dataclass(frozen=True, eq=False)
class Placement:
    """An object at a place. number: of the object in the library · probability: that the pose, or one of its
    alternatives, is right · explains: numbers of the samples of the scene's surface that lie on the object."""

    number: int
    name: str
    T_object_scene: Sim3
    probability: float
    verdict: Verdict
    reason: str
    explains: Integers
    alternatives: tuple[Sim3, ...] = ()

    @property
    def T_scene_object(self) -> Sim3:
        """The object's pose in the scene."""
        return self.T_object_scene.inverse()


def box_of_pose(model: ObjectModel, T_object_scene: Sim3) -> OrientedBox:
    """A box around the placed object, scene frame, a little larger."""
    low, high = model.bounds
    back = T_object_scene.inverse()
    size = (high - low) * float(back.scale)
    return OrientedBox(back.apply(((low + high) / 2)[None])[0], size * _LARGER + _MARGIN * size.norm(), back.rotation)


def placed_samples(model: ObjectModel, T_object_scene: Sim3) -> Tensor:
    """(M, 3) float64: the samples of the object's surface, scene frame."""
    return T_object_scene.apply_inverse(model.frame.out_of(model.samples.on_surface()))


def explained(surface: SceneSurface, obj: SdfField, model: ObjectModel, T_object_scene: Sim3) -> Integers:
    """Numbers of the samples of the scene's surface that lie on the placed object's."""
    tolerance = max(_TOLERANCE * surface.spacing * float(T_object_scene.scale), _LEAST_TOLERANCE * model.frame.length)
    moved = T_object_scene.apply(torch.from_numpy(surface.points))
    low, high = model.bounds
    near = ((moved >= low - tolerance) & (moved <= high + tolerance)).all(-1).nonzero()[:, 0]
    if not len(near):
        return np.zeros(0, np.int64)
    distance, gradient = (one.double().cpu() for one in obj.signed_distance_and_gradient(moved[near].float()))
    normals = torch.from_numpy(surface.normals)[near] @ T_object_scene.rotation.mT
    alike = (normals * gradient).sum(-1) > _ALIKE * gradient.norm(dim=-1)
    found: Integers = near[(distance.abs() <= tolerance) & alike].numpy()
    return found


@dataclass(frozen=True, eq=False)
class Seeker:
    """What finds a library's objects in boxes of one scene."""

    scene: SdfField
    surface: SceneSurface
    library: Sequence[LibraryObject]
    options: RegistrationOptions
    seed: int

    def confirmed_in(self, box: OrientedBox) -> Placement | None:
        """The most probable object in the box, sought again in a box of its own; None: nothing is probable."""
        first = self.best_in(box)
        if first is None or first.probability < _WORTH:
            return None
        found = self.best_in(box_of_pose(self.library[first.number].model, first.T_object_scene))
        return None if found is None or found.reason == "OUTSIDE_DETECTION" else found

    def best_in(self, box: OrientedBox) -> Placement | None:
        """The library's most probable object in the box, whatever its verdict; None: no surface, or none fits in."""
        numbers = self._fitting(box)
        if not numbers:
            return None
        try:
            view = view_scene(self.scene, box, self.options.robust)
        except (NoSurfaceError, InvalidDetectionError):
            return None
        some = [self.library[number] for number in numbers]
        _, _, refined, _ = refined_objects(
            self.scene, view, some, self.options, self.seed, Run(None), _WORST, _SHORTLIST
        )
        if not refined:
            return None
        evaluation, number, _, _ = refined[0]
        one, T, found = some[number], evaluation.T, evaluation.found
        return Placement(
            numbers[number],
            one.name,
            T,
            evaluation.metrics["probability"],
            found.verdict,
            found.reason,
            explained(self.surface, one.field(), one.model, T),
            tuple(other.T_object_scene for other in evaluation.alternatives),
        )

    def _fitting(self, box: OrientedBox) -> list[int]:
        """Numbers of the objects that may have the size of the box, where the scale is known."""
        low, high = self.options.robust.scale_range
        smallest, largest = (share * box.diagonal for share in _FITTING)
        return [
            number
            for number, one in enumerate(self.library)
            if (high is None or one.model.frame.length / high <= largest)
            and (low is None or one.model.frame.length / low >= smallest)
        ]

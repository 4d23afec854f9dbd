"""What changed between two maps of one place: objects that stayed, moved, are gone, are new.

Both maps are populated, and their placements matched object by object. A placement without a match is looked for in the
other map where it stood: the map may show its surface there, show free space, or not have seen the place. Both maps
must be in one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from regnf_core.fields.observation import SdfField, observation_of
from regnf_core.library import LibraryObject
from regnf_core.population.placements import Placement, placed_samples
from regnf_core.population.populate import Population
from regnf_core.robust.model import ObjectModel
from regnf_core.robust.verdict.answer import alike_poses
from regnf_core.schema.description import UNSEEN

Change = Literal["stayed", "moved", "gone", "new", "unknown"]
_NEAR, _NEAR_SPACINGS = 0.03, 2.0
"""Object diameters, and spacings of the samples, up to which a place is the same: larger than the errors of poses."""
_SHOWN = 0.5
"""Share of an object's observed surface that a map must show, or show to be free."""
_LEAST_SEEN = 0.2
"""Share of an object's surface that must have been observed."""


@dataclass(frozen=True, eq=False)
class ObjectChange:
    """before, after: the placements, None where there is none · moved: how far the object's center moved, scene
    units · probability: that this is so."""

    change: Change
    name: str
    before: Placement | None
    after: Placement | None
    moved: float
    probability: float

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        poses = {"before": self.before, "after": self.after}
        matrices = {k: None if one is None else one.T_scene_object.matrix().tolist() for k, one in poses.items()}
        told = {"change": self.change, "object": self.name, "moved": self.moved, "probability": self.probability}
        return {**told, "T_scene_object": matrices}


def compare(
    before: tuple[SdfField, Population], after: tuple[SdfField, Population], library: Sequence[LibraryObject]
) -> list[ObjectChange]:
    """The changes from one map to the other, by what was found in both."""
    found: list[ObjectChange] = []
    for number, one in enumerate(library):
        old = [each for each in before[1].placements if each.number == number]
        new = [each for each in after[1].placements if each.number == number]
        near = _NEAR * one.model.frame.length
        spacing = max(before[1].surface.spacing, after[1].surface.spacing)
        apart = np.array([[_apart(a, b, one.model) for b in new] for a in old]).reshape(len(old), len(new))
        rows, columns = linear_sum_assignment(apart)
        for a, b in zip(rows.tolist(), columns.tolist(), strict=True):
            limit = max(near / float(old[a].T_object_scene.scale), _NEAR_SPACINGS * spacing)
            moved = float((_center(old[a], one.model) - _center(new[b], one.model)).norm())
            likely = old[a].probability * new[b].probability
            change: Change = "stayed" if apart[a, b] <= limit else "moved"
            found.append(ObjectChange(change, one.name, old[a], new[b], moved if change == "moved" else 0.0, likely))
        left = [old[a] for a in range(len(old)) if a not in rows]
        come = [new[b] for b in range(len(new)) if b not in columns]
        found += [_alone(placement, after[0], one, spacing, True) for placement in left]
        found += [_alone(placement, before[0], one, spacing, False) for placement in come]
    return found


def _alone(placement: Placement, other: SdfField, one: LibraryObject, spacing: float, was: bool) -> ObjectChange:
    """Of a placement that the other map's population lacks. was: it is of the map before."""
    shown, free, seen = presence(other, placed_samples(one.model, placement.T_object_scene), spacing)
    change: Change = "unknown"
    if seen >= _LEAST_SEEN and shown >= _SHOWN:
        change = "stayed"
    elif seen >= _LEAST_SEEN and free >= _SHOWN:
        change = "gone" if was else "new"
    likely = placement.probability * {"stayed": shown, "unknown": 1.0}.get(change, free)
    old, new = (placement, None) if was else (None, placement)
    return ObjectChange(change, placement.name, old, new, 0.0, likely)


def presence(scene: SdfField, points: torch.Tensor, spacing: float) -> tuple[float, float, float]:
    """Of points (N, 3) of a placed surface: the shares of the observed ones that the scene shows, and shows to be free;
    and the share that was observed."""
    distance = scene.signed_distance(points.float()).double().cpu()
    observation = observation_of(scene)
    low, high = scene.bounds
    seen = ((points >= low) & (points <= high)).all(-1)
    seen &= distance > -_NEAR_SPACINGS * spacing  # matter in front of it hides it
    if observation is not None:
        seen &= observation.at(points) != UNSEEN
    count = max(int(seen.sum()), 1)
    shown = (distance.abs() <= _NEAR_SPACINGS * spacing) & seen
    free = (distance > _NEAR_SPACINGS * spacing) & seen
    return int(shown.sum()) / count, int(free.sum()) / count, int(seen.sum()) / max(len(points), 1)


def _center(placement: Placement, model: ObjectModel) -> torch.Tensor:
    return placement.T_object_scene.apply_inverse(model.frame.center[None])[0]


def _apart(one: Placement, other: Placement, model: ObjectModel) -> float:
    """How far two placements put the object's outermost points apart, scene units, up to its symmetries."""
    points = model.frame.out_of(model.extremal_points)
    back = model.frame.to_field()
    alike = back @ alike_poses(model.symmetry) @ back.inverse()
    there = torch.cat([T.apply_inverse(points)[None] for T in (one.T_object_scene, *one.alternatives)])
    turned = alike.apply_inverse(points)
    here = other.T_object_scene.apply_inverse(turned.reshape(-1, 3)).reshape(turned.shape)
    return float((there[:, None] - here[None]).norm(dim=-1).amax(-1).min())

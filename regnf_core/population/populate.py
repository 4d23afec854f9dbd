"""A library's objects found in a whole scene, without boxes.

found = populate(scene, library, options)
[(one.name, one.T_scene_object, one.probability) for one in found.placements]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from regnf_core.document import TransformDocument
from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField
from regnf_core.geometry.box import OrientedBox
from regnf_core.geometry.sim3 import Sim3
from regnf_core.library import LibraryObject
from regnf_core.options import RegistrationOptions
from regnf_core.population.consistency import conflicts, distinct, together, within_boundary
from regnf_core.population.placements import Placement, Seeker, box_of_pose
from regnf_core.population.proposals import (
    Floats,
    Integers,
    Mask,
    SceneSurface,
    pieces,
    proposals,
    scene_surface,
)
from regnf_core.processes import can_fork, in_processes
from regnf_core.robust.verdict.evaluation import LEVELS

_ROUNDS, _MOST_PROPOSALS, _AT_ONCE = 3, 60, 8
"""Rounds at most; proposals of the first, of each other half as many; proposals before the placements are looked at."""
_EXPLAINED = 0.5
"""Share of a proposal's samples that are explained already, from which on it is passed over."""
_UNSURE = 0.3
"""Probability of a placement that is listed though it is not accepted."""
_MOST_UNEXPLAINED = 30

Watch = Callable[[float, Sequence[Placement]], None]
"""Called with the share done, 0..1, and the placements so far. It may raise CancelledError."""


@dataclass(frozen=True, eq=False)
class Population:
    """placements: accepted, and consistent with one another, the most probable first · unsure: others that were
    considered · unexplained: boxes of surface that nothing explains, the largest first · surface: of the scene · free:
    (N,), which of its samples nothing explains · searched: boxes in which the library was sought."""

    library: Sequence[LibraryObject]
    placements: list[Placement]
    unsure: list[Placement]
    unexplained: list[OrientedBox]
    surface: SceneSurface
    free: Mask
    searched: int

    def up(self) -> Floats | None:
        """(3,) the normal of the boundary plane on which most of the placed objects stand; None: there is no plane."""
        if not self.surface.boundary:
            return None
        on = [sum(len(one.explains) for one in self.placements if self._stands(one, n)) for n in self._planes()]
        return self.surface.boundary[int(np.argmax(on))].normal

    def _planes(self) -> range:
        return range(len(self.surface.boundary))

    def _stands(self, placement: Placement, number: int) -> bool:
        heights = self.surface.boundary[number].height(self.surface.points[placement.explains])
        return bool(len(heights)) and float(heights.min()) < self.surface.cut + _REST * self.surface.spacing

    def box(self, placement: Placement) -> OrientedBox:
        """Around a placed object, scene frame."""
        return box_of_pose(self.library[placement.number].model, placement.T_object_scene)

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        share = float(self.free.mean()) if len(self.free) else 0.0
        up = self.up()
        return {
            "placements": [
                _document(one) | {"box": self.box(one).to_detection().canonical()} for one in self.placements
            ],
            "unsure": [_document(one) for one in self.unsure],
            "unexplained": [_values(one) for one in self.unexplained],
            "unexplained_share": share,
            "up": None if up is None else up.tolist(),
            "boundary": [{"normal": one.normal.tolist(), "offset": one.offset} for one in self.surface.boundary],
            "searched": self.searched,
        }


_REST = 3.0
"""Spacings above the samples that were left out at a boundary plane, up to which an object's lowest stands on it."""


def _values(box: OrientedBox) -> dict[str, Any]:
    return box.to_detection().canonical()


def _document(one: Placement) -> dict[str, Any]:
    def both(T: Sim3) -> dict[str, Any]:
        there, back = TransformDocument(**T.inverse().to_dict()), TransformDocument(**T.to_dict())
        return {"T_scene_object": there.model_dump(), "T_object_scene": back.model_dump()}

    alternatives = [both(T) for T in one.alternatives]
    told = {"object": one.name, "probability": one.probability, "verdict": one.verdict, "verdict_reason": one.reason}
    return {**told, **both(one.T_object_scene), "samples": len(one.explains), "alternatives": alternatives}


def populate(
    scene: SdfField,
    library: Sequence[LibraryObject],
    options: RegistrationOptions | None = None,
    seed: int = 0,
    detections: Sequence[OrientedBox] = (),
    processes: int = 1,
    watch: Watch = lambda share, placed: None,
) -> Population:
    """Find the library's objects in a scene: any number of each, also none.

    A placement is accepted from the level `strict` on, unless ``min_probability`` is given: most of the boxes hold
    nothing of the library, while a registration's probability assumes that half of all requests are right.
    detections: boxes of a detector, which are searched before all others · processes: copies of this process that share
    the work; the result is the same for any number. Deterministic for a seed.
    Raises InvalidOptionsError (PRESET_UNSUITABLE), InvalidInputError (LIBRARY_EMPTY, FIELD_NOT_FINITE), NoSurfaceError.
    """
    options = options or RegistrationOptions()
    options.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    if not library:
        raise InvalidInputError("the library has no objects", reason="LIBRARY_EMPTY")
    surface = scene_surface(scene)
    seeker = Seeker(scene, surface, library, options, seed)
    said = options.robust.min_probability
    found = _Found(library, surface, LEVELS["strict"] if said is None else said)
    tried: list[Integers] = []
    searched, total = 0, len(detections) + sum(_MOST_PROPOSALS >> turn for turn in range(_ROUNDS))

    def search(boxes: list[OrientedBox]) -> None:
        nonlocal searched

        def told() -> None:
            watch(min(searched / total, 1.0), found.placed)

        work: Iterable[Placement | None] = map(seeker.confirmed_in, boxes)
        if processes > 1 and can_fork():
            work = in_processes(seeker.confirmed_in, boxes, processes, told)
        told()
        found.add([one for one in work if one is not None])
        searched += len(boxes)
        told()

    if detections:
        search(list(detections))
    for turn in range(_ROUNDS):
        left, before = proposals(surface, found.free, _MOST_PROPOSALS >> turn, tried), len(found.placed)
        tried += [one.samples for one in left]
        while left:
            boxes: list[OrientedBox] = []
            while left and len(boxes) < _AT_ONCE:
                one = left.pop(0)
                if found.free[one.samples].mean() > 1.0 - _EXPLAINED:
                    boxes.append(one.box)
            search(boxes)
        if len(found.placed) == before:
            break
    rest = [one.box for one in islice(pieces(surface, found.free), _MOST_UNEXPLAINED)]
    return Population(library, found.placed, found.unsure, rest, surface, found.free, searched)


class _Found:
    """What was found so far. least: probability of an accepted placement."""

    def __init__(self, library: Sequence[LibraryObject], surface: SceneSurface, least: float) -> None:
        self._library, self._surface, self._least = library, surface, least
        self._known: list[Placement] = []
        self.placed: list[Placement] = []
        self.unsure: list[Placement] = []
        self.free = np.ones(len(surface), bool)

    def add(self, found: Sequence[Placement]) -> None:
        """Choose anew what stands together."""
        sound = [one for one in found if within_boundary(one, self._library, self._surface)]
        self._known = distinct([*self._known, *sound])
        excluded = conflicts(self._known, self._library, self._surface.spacing)
        chosen, likely = together(self._known, excluded, self._least)
        among = [replace(one, probability=float(p)) for one, p in zip(self._known, likely, strict=True)]
        among_chosen = [among[number] for number in chosen]
        self.placed = sorted(among_chosen, key=lambda one: -one.probability)
        others = [one for number, one in enumerate(among) if number not in chosen and one.probability >= _UNSURE]
        self.unsure = sorted(others, key=lambda one: -one.probability)
        self.free = np.ones(len(self._surface), bool)
        for one in self.placed:
            self.free[one.explains] = False

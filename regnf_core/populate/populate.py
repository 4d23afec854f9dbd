"""A library's objects found in a whole scene, without boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from regnf_core.errors import InvalidInputError
from regnf_core.fields.observation import SdfField
from regnf_core.library import LibraryObject
from regnf_core.options import RegistrationOptions
from regnf_core.populate.consistency import conflicts, distinct, together, within_boundary
from regnf_core.populate.placements import Placement, Seeker
from regnf_core.populate.proposals import Integers, Mask, Proposal, SceneSurface, proposals, scene_surface
from regnf_core.processes import can_fork, in_processes
from regnf_core.robust.verdict.evaluation import least_probability

_ROUNDS, _MOST_PROPOSALS, _AT_ONCE = 3, 60, 8
_EXPLAINED = 0.5
"""Share of a proposal's samples that are explained already, from which on it is passed over."""


@dataclass(frozen=True, eq=False)
class Populated:
    """placements: that stand together, the most probable first · unsure: others that were considered · surface ·
    unexplained: (N,) which samples nothing explains."""

    placements: list[Placement]
    unsure: list[Placement]
    surface: SceneSurface
    unexplained: Mask
    searched: int


def populate(
    scene: SdfField,
    library: Sequence[LibraryObject],
    options: RegistrationOptions | None = None,
    seed: int = 0,
    processes: int = 1,
    progress: Callable[[float, Sequence[Placement]], None] = lambda share, placed: None,
) -> Populated:
    options = options or RegistrationOptions()
    options.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    if not library:
        raise InvalidInputError("the library has no objects", reason="LIBRARY_EMPTY")
    surface = scene_surface(scene)
    seeker = Seeker(scene, surface, library, options, seed)
    least = least_probability(options.robust)
    state = _State(library, surface, least)
    tried: list[Integers] = []
    searched = 0
    for turn in range(_ROUNDS):
        found = proposals(surface, state.free, _MOST_PROPOSALS >> turn, tried)
        before = len(state.placed)
        while found:
            batch: list[Proposal] = []
            while found and len(batch) < _AT_ONCE:
                one = found.pop(0)
                tried.append(one.samples)
                if state.free[one.samples].mean() > 1.0 - _EXPLAINED:
                    batch.append(one)
            tasks = [one.box for one in batch]
            searched += len(tasks)
            work = in_processes(seeker.at, tasks, processes) if processes > 1 and can_fork() else map(seeker.at, tasks)
            state.add([one for one in work if one is not None])
            progress(0.0, state.placed)
        if len(state.placed) == before:
            break
    return Populated(state.placed, state.unsure, surface, state.free, searched)


class _State:
    """What was found so far."""

    def __init__(self, library: Sequence[LibraryObject], surface: SceneSurface, least: float) -> None:
        self._library, self._surface, self._least = library, surface, least
        self._known: list[Placement] = []
        self.placed: list[Placement] = []
        self.unsure: list[Placement] = []
        self.free = np.ones(len(surface), bool)

    def add(self, found: Sequence[Placement]) -> None:
        sound = [one for one in found if within_boundary(one, self._library, self._surface)]
        self._known = distinct([*self._known, *sound])
        excluded = conflicts(self._known, self._library, self._surface.spacing)
        chosen, likely = together(self._known, excluded, self._least)
        among = [replace(one, probability=float(p)) for one, p in zip(self._known, likely, strict=True)]
        self.placed = sorted((among[number] for number in chosen), key=lambda one: -one.probability)
        self.unsure = [one for number, one in enumerate(among) if number not in chosen]
        self.free = np.ones(len(self._surface), bool)
        for one in self.placed:
            self.free[one.explains] = False

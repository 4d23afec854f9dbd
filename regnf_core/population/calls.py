"""``populate`` and ``compare`` as users call them: fields by their paths, a library by its folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from regnf_core.api import FieldLike, Objects, box_of, modeled_library, opened
from regnf_core.detections.parsing import BoxLike
from regnf_core.options import OptionsLike, options_of, seed_of
from regnf_core.population.compare import ObjectChange
from regnf_core.population.compare import compare as compare_populations
from regnf_core.population.placements import Placement
from regnf_core.population.populate import Population, Watch
from regnf_core.population.populate import populate as populate_scene


def populate(
    scene: FieldLike,
    objects: Objects,
    options: OptionsLike = None,
    seed: int = 0,
    detections: Sequence[BoxLike] = (),
    processes: int | None = None,
    watch: Watch = lambda share, placed: None,
) -> Population:
    """Find all objects of a library in a scene, without boxes: where each stands, how sure that is, and what is left.

    scene: a field or its path · objects: as in :func:`regnf.search` · options: of the preset `robust`; give the scale
    where it is known (``object_unit`` or ``min_scale`` and ``max_scale``) · detections: boxes to search first ·
    processes: that share the work; None: one per core · watch: called with the share done and the placements so far.
    Raises what :func:`regnf.search` raises.
    """
    chosen, seed, boxes = options_of(options), seed_of(seed), [box_of(one) for one in detections]
    chosen.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    library, _ = modeled_library(objects, chosen.robust, [scene])
    place = opened(scene, "scene")
    return populate_scene(place.field, library, chosen, seed, boxes, processes or cores(), watch)


@dataclass(frozen=True, eq=False)
class Changes:
    """What changed between two maps. before, after: what was found in them · objects: the changes, object by object."""

    before: Population
    after: Population
    objects: list[ObjectChange]

    def to_dict(self) -> dict[str, Any]:
        """Plain (JSON) values."""
        return {
            "changes": [one.to_dict() for one in self.objects],
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
        }


def compare(
    before: FieldLike,
    after: FieldLike,
    objects: Objects,
    options: OptionsLike = None,
    seed: int = 0,
    processes: int | None = None,
    watch: Watch = lambda share, placed: None,
) -> Changes:
    """Which objects of a library stayed, moved, are gone or new between two maps of a place, which share their frame.

    Arguments as in :func:`populate`.
    """
    chosen, seed = options_of(options), seed_of(seed)
    chosen.require_robust("searches a library", reason="PRESET_UNSUITABLE")
    library, _ = modeled_library(objects, chosen.robust, [before, after])
    fields = [opened(one, "scene").field for one in (before, after)]
    found = []
    for number, field in enumerate(fields):

        def half(share: float, placed: Sequence[Placement], number: int = number) -> None:
            watch((number + share) / 2, placed)

        found.append(populate_scene(field, library, chosen, seed, (), processes or cores(), half))
    changes = compare_populations((fields[0], found[0]), (fields[1], found[1]), library)
    return Changes(found[0], found[1], changes)


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

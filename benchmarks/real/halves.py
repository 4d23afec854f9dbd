"""The two halves of a sequence: one that objects are cut from, one that they are found in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Halves:
    """frames: of a sequence of so many, first those that objects are cut from, then those of the map · drifts: the
    poses of the two disagree, so that the truth itself is only known to the drift."""

    name: str
    frames: Callable[[int], tuple[range, range]]
    drifts: bool


INTERLEAVED = Halves("interleaved", lambda count: (range(0, count, 4), range(2, count, 4)), drifts=False)
APART = Halves("apart", lambda count: (range(0, count // 2, 2), range(count // 2, count, 2)), drifts=True)
HALVES = {halves.name: halves for halves in (INTERLEAVED, APART)}

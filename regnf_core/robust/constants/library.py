"""The search of a library.

The package's docstring explains the sources.
"""

from __future__ import annotations

from dataclasses import dataclass

from regnf_core.robust.stage import Stage


@dataclass(frozen=True)
class LibraryConstants:
    """Search of a library (library_search.py)."""

    shortlist: int = 12
    """Objects that are searched coarsely. With 64 objects the right one was never below place 7. [library]"""
    max_refined: int = 4
    """Objects that are refined on their fields: the time of a search is bounded by this. [by hand]"""
    margin: float = 0.15
    """Coarse score. Objects farther behind the best one are not refined. [by hand]"""
    rotations_divisor: float = 2.5
    """Rotations of a registration for each one of the coarse search. [by hand]"""
    stages: tuple[Stage, ...] = (
        Stage(points=48, widths=(), score_width=0.10, keep=120),
        Stage(points=64, widths=(0.15, 0.12, 0.10, 0.08), score_width=0.06, keep=30, min_distance=0.05),
        Stage(points=128, widths=(0.08, 0.06, 0.05, 0.04), score_width=0.04, keep=8, min_distance=0.05),
    )
    """The coarse search: the first stages of a registration with a quarter of the poses. [by hand]"""


LIBRARY = LibraryConstants()

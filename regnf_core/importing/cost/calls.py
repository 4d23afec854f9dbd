"""How many points the gate evaluates a field at: the checks of plausibility, and the trials of several readings."""

from __future__ import annotations

from dataclasses import dataclass

SAMPLES = 16_384
"""Points that a field is checked at."""
TRIAL_POINTS = 1_024
"""Points that each of several readings is tried at, with its gradient."""
MAX_TRIED, TRIED_MORE, TRIED_NEAR = 64, 128, 32
"""The most usual readings, which are all tried; more of them, where no levels tell; and those next to the best one."""
CLIMB_POINTS, MAX_CLIMBS = 2_048, 3
"""Points at which better readings are looked for beside the best one, and how often from there on."""
WRITTEN_NEAR, READINGS_BESIDE = 13, 11
"""Readings that are tried beside the best one: of numbers that somebody would write, and of others."""
FINAL_POINTS, FINALISTS = 8_192, 12
"""Points of the second round, and how many rivals may come into it."""
LAST_POINTS, LAST_FINALISTS = 32_768, 3
"""The same of the third round, for what the second one leaves open. The interpolation is told at as many points."""
SHARES = (1, 2, 4, 8)
"""Of a field whose trials would take too long, all rounds but the first have a half, a quarter or an eighth of the
points."""
NEAREST_SHARE = 16
ASKED_AGAIN = 64
STEPS = 8
FACES, FACE_SHARE = 6, 64
COLOR_POINTS = 1 << 16
"""A color must be affordable at so many points: those of a small picture."""
GRADIENT = 3.0
"""A value with its gradient takes as long as so many values."""


@dataclass(frozen=True)
class Calls:
    """Points of every call for values, and of every call for values with gradients."""

    values: tuple[int, ...]
    gradients: tuple[int, ...]

    @property
    def points(self) -> float:
        """How many points' values would take as long."""
        return sum(self.values) + GRADIENT * sum(self.gradients)


def calls_of_check(samples: int) -> Calls:
    """What one check of plausibility evaluates."""
    nearest = samples // NEAREST_SHARE
    return Calls((samples, ASKED_AGAIN, FACES * (samples // FACE_SHARE)), (nearest,) * (STEPS + 1))


def calls_of_trials(readings: int, share: int = 1) -> Calls:
    """What the choice among so many readings evaluates at most; after the first round at one ``share``-th of the
    points."""
    first = (TRIAL_POINTS,) * (min(readings, MAX_TRIED + TRIED_MORE + TRIED_NEAR) + 1)
    climbs = (CLIMB_POINTS,) * (MAX_CLIMBS * (WRITTEN_NEAR + READINGS_BESIDE) + 1)
    final = (FINAL_POINTS,) * (2 * min(readings, FINALISTS) + LAST_FINALISTS + READINGS_BESIDE + 7)
    last = (LAST_POINTS,) * (LAST_FINALISTS + 3)
    values = tuple(
        4 * points // share
        for points in (CLIMB_POINTS, FINAL_POINTS, FINAL_POINTS, FINAL_POINTS, LAST_POINTS, LAST_POINTS)
    )
    gradients = tuple(points // share for points in climbs + final + last)
    return Calls((4 * TRIAL_POINTS, *values), first + gradients)

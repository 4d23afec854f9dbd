"""How many points the gate evaluates a field at: the checks of plausibility, and the trials of several readings."""

from __future__ import annotations

from dataclasses import dataclass

SAMPLES = 16_384
"""Points that a field is checked at."""
TRIAL_POINTS = 1_024
"""Points that each of several readings is tried at, with its gradient."""
FINAL_POINTS, FINALISTS = 8_192, 12
"""Points of the second round, and how many readings may come into it."""
NEAREST_SHARE = 16
ASKED_AGAIN = 64
STEPS = 8
FACES, FACE_SHARE = 6, 64
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


def calls_of_trials(readings: int) -> Calls:
    """What the choice among so many readings evaluates at most: both rounds, and two interpolations."""
    final = (FINAL_POINTS,) * (min(readings, FINALISTS) + 2)
    return Calls((4 * TRIAL_POINTS, 4 * FINAL_POINTS), (TRIAL_POINTS,) * (readings + 1) + final)

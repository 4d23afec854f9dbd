"""The choice by the mean misfit and by usual numbers, on trials whose misfits are made."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch

from regnf_core.importing.families.converted import Reading
from regnf_core.importing.gate.choice import chosen_by_misfit
from regnf_core.importing.gate.evidence import Trial

POINTS = 2000


def trial(name: str, misfit: float, tier: int = 0, top: float | None = 512.0) -> Trial:
    """A reading of its own function whose gradient's norm is off by about ``misfit``."""
    generator = torch.Generator().manual_seed(sum(name.encode()))
    values = misfit + 0.01 * torch.randn(POINTS, generator=generator)
    scale = None if top is None else math.log(top)
    return Trial(
        Reading(name, {}, {}, tier=tier, scale=scale), torch.randn(POINTS, generator=generator), values, values
    )


@dataclass
class Again:
    """The second round: the same trials."""

    trials: list[Trial]

    def of(self, reading: Reading) -> Trial:
        return next(trial for trial in self.trials if trial.reading is reading)


NEIGHBORS = trial("500", 0.1, 1, 500.0), trial("530", 0.1, 1, 530.0)


@pytest.mark.parametrize(
    ("trials", "name"),
    [
        ((trial("far", 0.3), trial("near", 0.1), trial("farther", 0.5)), "near"),
        ((trial("512", 0.1), *NEIGHBORS), "512"),  # a usual number among others close to it is no accident
        (NEIGHBORS, None),
        *(
            ((trial("512", 0.1), trial(f"{tier} {top}", 0.1, tier, top)), None)
            for tier, top in ((0, 512.0), (1, 1024.0), (1, None))
        ),
        ((trial("far", 0.9), trial("less far", 0.6)), None),  # the best is no distance: it speaks against no other
    ],
)
def test_what_is_chosen_or_left_open(trials: tuple[Trial, ...], name: str | None) -> None:
    found, fitting = chosen_by_misfit(trials, Again(list(trials)))  # type: ignore[arg-type]
    assert found is None or fitting[0] is found
    assert (None if found is None else found.reading.name) == name

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


def chosen(*trials: Trial) -> str | None:
    found, fitting = chosen_by_misfit(trials, Again(list(trials)))  # type: ignore[arg-type]
    assert found is None or fitting[0] is found
    return None if found is None else found.reading.name


def test_what_fits_clearly_best_is_chosen() -> None:
    assert chosen(trial("far", 0.3), trial("near", 0.1), trial("farther", 0.5)) == "near"


def test_a_usual_number_among_others_close_to_it_is_no_accident() -> None:
    others = trial("500", 0.1, 1, 500.0), trial("530", 0.1, 1, 530.0)
    assert chosen(trial("512", 0.1), *others) == "512"


@pytest.mark.parametrize(
    "other", [trial("as usual", 0.1, 0), trial("far from it", 0.1, 1, 1024.0), trial("of no size", 0.1, 1, None)]
)
def test_it_is_left_open_otherwise(other: Trial) -> None:
    assert chosen(trial("512", 0.1), other) is None


def test_unusual_numbers_alone_are_left_open() -> None:
    assert chosen(trial("500", 0.1, 1, 500.0), trial("530", 0.1, 1, 530.0)) is None


def test_a_best_one_that_is_no_distance_speaks_against_no_other() -> None:
    assert chosen(trial("far", 0.9), trial("less far", 0.6)) is None

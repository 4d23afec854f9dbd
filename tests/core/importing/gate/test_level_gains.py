"""A level's gain tells whether it was read as it was trained: gradients whose truth is known."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from regnf_core.importing.families.converted import Reading
from regnf_core.importing.gate.choice import told_interpolation
from regnf_core.importing.gate.evidence import LevelGains, Trial, level_gains

POINTS = 4000


def unit_and_noise(seed: int) -> tuple[Tensor, Tensor]:
    """Gradients of a distance (N, 3), and what a level got wrong or right of them (N, 3)."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.nn.functional.normalize(torch.randn(POINTS, 3, generator=generator), dim=-1)
    return unit, 0.3 * torch.randn(POINTS, 3, generator=generator)


def gains_of(rest: Tensor, levels: Tensor, cells: float = 64.0) -> LevelGains:
    """The gains at points that are anywhere, of levels of so many cells."""
    places = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(20))
    return LevelGains(level_gains(rest, levels), torch.full((len(levels),), cells), places)


def in_errors(gains: LevelGains) -> list[float]:
    """Each level's mean in standard errors."""
    levels = zip(gains.gains, gains.scales, strict=True)
    told = [LevelGains(gain[None], scale[None], gains.places).support() for gain, scale in levels]
    return [math.copysign(math.sqrt(2.0 * abs(one)), one) for one in told]


def test_a_level_gains_where_it_corrects_the_others() -> None:
    """Not where it is read from the wrong rows; and a fine level's noise does not hide what a coarse one does."""
    unit, error = unit_and_noise(0)
    elsewhere = error[torch.randperm(POINTS, generator=torch.Generator().manual_seed(2))]
    corrects, wrong, noise = (
        in_errors(gains_of(unit - error, levels))
        for levels in (error[None], elsewhere[None], torch.stack((error, 10.0 * unit_and_noise(4)[1])))
    )
    assert corrects[0] > 20.0
    assert noise[0] > 20.0
    assert max(abs(wrong[0]), abs(noise[1])) < 4.0
    assert level_gains(unit, 1e-5 * unit[None]).abs().max() == 0.0, "a level that hardly counts says nothing"


def test_a_level_of_few_cells_says_little_however_many_points_there_are() -> None:
    """All points of a block have one random gain: chance, that each block adds to once."""
    generator = torch.Generator().manual_seed(30)
    places = torch.rand(POINTS, 3, generator=generator)
    said = []
    for _ in range(200):
        block = (places * 2).long() @ torch.tensor([4, 2, 1])
        gains = torch.randn(8, generator=generator)[block]
        said += in_errors(LevelGains(gains[None], torch.tensor([4.0]), places))
    assert max(map(abs, said)) < 4.5
    assert abs(sum(said)) / 200 < 0.5


def test_of_as_many_cells_as_points_each_point_counts() -> None:
    generator = torch.Generator().manual_seed(31)
    gains = 0.1 + torch.randn(1, POINTS, generator=generator)
    places = torch.rand(POINTS, 3, generator=generator)
    (told,) = in_errors(LevelGains(gains, torch.tensor([1000.0]), places))
    assert abs(told - float(gains.mean() / gains.std()) * POINTS**0.5) < 0.2


def trial(level: Tensor, rest: Tensor) -> Trial:
    reading = Reading("a grid", {}, {})
    gradient = rest + level
    return Trial(reading, gradient[:, 0], gradient, gradient.norm(dim=-1), gains_of(rest, level[None]))


def test_levels_alone_do_not_tell_the_interpolation_but_contradict_a_wrong_one() -> None:
    unit, error = unit_and_noise(6)
    elsewhere = error[torch.randperm(POINTS, generator=torch.Generator().manual_seed(9))]
    within = 6.0 * torch.rand(POINTS, 1, generator=torch.Generator().manual_seed(7))
    within = within * (1.0 - within / 6.0)
    for truth, other in ((error, error * within), (error * within, error), (elsewhere, elsewhere * within)):
        right, wrong = trial(truth, unit - truth), trial(other, unit - truth)
        assert told_interpolation(right, wrong) != "smoothstep"
        assert told_interpolation(wrong, right) != "linear"
    assert told_interpolation(trial(elsewhere, unit - error), trial(elsewhere * within, unit - error)) is None

"""How much of the object the agreement covers: patches counted by hand, and against a slow count."""

from __future__ import annotations

import pytest
import torch

from regnf_core.robust.constants import EVIDENCE
from regnf_core.robust.verdict.evidence import coverage

CENTERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def about(counts: list[int]) -> torch.Tensor:
    """So many points at each of the centers, a little beside it."""
    return torch.repeat_interleave(CENTERS, torch.tensor(counts), dim=0) + torch.tensor([0.1, 0.2, 0.0])


def test_patches_by_hand() -> None:
    """Two poses. Three of ten samples confirm a patch, two do not; five scene samples cover it, four do not."""
    mine, theirs = about([10, 10, 10, 10]), about([5, 4, 0, 9])
    confirmed = torch.zeros(2, 40, dtype=torch.bool)
    confirmed[0, [0, 1, 2, 10, 11, 30, 31, 32, 33]] = True
    near = torch.ones(2, 18, dtype=torch.bool)
    near[1, :5] = False
    found = coverage(CENTERS, mine, theirs.expand(2, -1, -1), confirmed, near)
    assert found["confirmed_patches"].tolist() == [0.5, 0.0]
    assert found["covered_patches"].tolist() == [0.5, 0.25]


def test_agreement_in_one_place_covers_less_than_the_same_spread_out() -> None:
    mine, nothing = about([12, 12, 12, 12]), torch.zeros(1, 1, dtype=torch.bool)
    together, spread = torch.zeros(1, 48, dtype=torch.bool), torch.zeros(1, 48, dtype=torch.bool)
    together[0, :16] = spread[0, ::3] = True
    assert int(together.sum()) == int(spread.sum())
    shares = [
        float(coverage(CENTERS, mine, CENTERS[None, :1], one, nothing)["confirmed_patches"][0])
        for one in (together, spread)
    ]
    assert shares == [0.5, 1.0]


@pytest.mark.parametrize("seed", [0, 1])
def test_against_a_slow_count(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    centers, mine = torch.randn(16, 3, generator=generator), torch.randn(300, 3, generator=generator)
    theirs = torch.randn(3, 200, 3, generator=generator)
    confirmed = torch.rand(3, 300, generator=generator) < 0.3
    near = torch.rand(3, 200, generator=generator) < 0.4
    found = coverage(centers, mine, theirs, confirmed, near)
    for pose in range(3):
        members: list[list[int]] = [[] for _ in centers]
        for number, point in enumerate(mine):
            members[min(range(16), key=lambda k: float((point - centers[k]).norm()))].append(number)
        shown = [0] * 16
        for number, point in enumerate(theirs[pose]):
            shown[min(range(16), key=lambda k: float((point - centers[k]).norm()))] += bool(near[pose, number])
        agreeing = [sum(bool(confirmed[pose, number]) for number in patch) for patch in members]
        enough = [a >= EVIDENCE.min_confirmed_in_patch * len(patch) for a, patch in zip(agreeing, members, strict=True)]
        assert float(found["confirmed_patches"][pose]) == pytest.approx(sum(enough) / 16)
        covered = sum(count >= EVIDENCE.min_samples_in_patch for count in shown)
        assert float(found["covered_patches"][pose]) == pytest.approx(covered / 16)

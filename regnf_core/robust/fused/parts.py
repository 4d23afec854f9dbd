"""The poses of several pairs in one row, cut into parts of one size.

A sum over a row of numbers, a matrix product or a network may round otherwise when the batch has another size. So every
part has the same size, whatever pairs are in it: the last one is filled up. What a pose becomes then depends on itself
alone, neither on the other pairs nor on their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_BYTES_A_SAMPLE = 512
"""What one sample of one pose takes while it is worked on: residuals and derivatives, before and after a step."""
_BYTES_A_PAIR = 4 * 2**20
"""What a pair takes all the time: two distance grids, samples, candidates."""
_STEP = 32
"""Parts hold a multiple of so many poses: whole vector registers, and rows enough that sums are taken alike."""


@dataclass(frozen=True)
class Sizes:
    """memory: bytes for the work on one part, and for what all pairs of a group hold."""

    memory: int

    def poses(self, points: int) -> int:
        """Poses of a part, with ``points`` samples of each surface: a power of two."""
        fit = self.memory // (2 * points * _BYTES_A_SAMPLE)
        return max(_STEP, 1 << max(0, fit.bit_length() - 1))

    @property
    def pairs(self) -> int:
        """Pairs of a group."""
        return max(1, self.memory // _BYTES_A_PAIR)


@dataclass(frozen=True, eq=False)
class Part:
    """Some of the poses of several pairs. runs: (number of the pair, how many of its poses follow), in order; the last
    one is longer where the part is filled up · pairs: (H,) the pair of each pose · rows: (H,) which pose each one is ·
    filling: how many of the last are there to fill it up."""

    runs: tuple[tuple[int, int], ...]
    pairs: Tensor
    rows: Tensor
    filling: int


def parts_of(counts: Sequence[int], size: int, device: torch.device) -> Iterator[Part]:
    """Parts of ``size`` poses for pairs with ``counts`` poses; filled up with the last pose."""
    total = sum(counts)
    owners = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    for begin in range(0, total, size):
        rows = torch.arange(begin, begin + size).clamp_max(total - 1)
        pairs = owners[rows]
        numbers, lengths = torch.unique_consecutive(pairs, return_counts=True)
        runs = tuple(zip(numbers.tolist(), lengths.tolist(), strict=True))
        yield Part(runs, pairs.to(device), rows.to(device), max(0, begin + size - total))

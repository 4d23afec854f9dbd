"""How much each level of a hash grid does for the gradient's norm: what a level read by another layout cannot do.

A level that is read as it was trained corrects the gradient that the coarser ones leave. Read by another layout its
part of the gradient is as large and points anywhere: taken away instead of added, it does as well. So the gain is the
misfit with the level's part subtracted less the misfit with it added, and chance alone makes it 0 whatever the level's
resolution. Levels are added from the coarsest on: a fine level's noise does not hide what a coarse one does.

Points of one cell share the level's entries, so that chance is told from blocks of cells and not from points. A level
of few cells has few blocks, and so it tells little, however many points there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.fields.base import SdfField
from regnf_core.fields.box_extension import BoxExtension
from regnf_core.fields.function_field import FunctionField
from regnf_core.fields.grid_mlp import GridMlpFunction
from regnf_core.fields.neus_facto_function import NeusFactoFunction

_CHUNK = 1024
_MOST = 3.0
"""Beyond this, the logarithm of the gradient's norm says no more."""
_LEAST_PART = 1e-3
"""A level whose part of the gradient is smaller on average says nothing."""
_BLOCK = 2.0
"""Cells along an edge of a block: an entry reaches into the cells on both sides of its node."""


@dataclass(frozen=True)
class LevelGains:
    """The gain of each level at each point (A, N), the levels' cells along an edge (A,) and the points' places in the
    grid's cube (N, 3), from 0 to 1."""

    gains: Tensor
    scales: Tensor
    places: Tensor

    def over(self, other: LevelGains) -> LevelGains:
        """The differences to ``other``, of as many levels at the same points."""
        return LevelGains(self.gains - other.gains, torch.minimum(self.scales, other.scales), self.places)

    def in_errors(self) -> Tensor:
        """The levels' means (A,) in standard errors; of few blocks, errors of as much likelihood (Student's t)."""
        told = [
            _in_errors(gain, float(scale), self.places) for gain, scale in zip(self.gains, self.scales, strict=True)
        ]
        return torch.stack(told)

    def support(self) -> float:
        """Log likelihood ratio that the levels' gains are more than chance; what speaks against it counts as much."""
        errors = self.in_errors()
        return 0.5 * float((errors * errors.abs()).sum())


@dataclass(frozen=True)
class PartsOfGradient:
    """Distances (N,), gradients (N, 3) but for the grid's part, each level's part (A, N, 3), and where the points are.

    scales, places: see :class:`LevelGains`.
    """

    distance: Tensor
    rest: Tensor
    levels: Tensor
    scales: Tensor
    places: Tensor

    def gains(self) -> LevelGains:
        """The levels' gains."""
        return LevelGains(level_gains(self.rest, self.levels), self.scales, self.places)


def norm_misfit(gradient: Tensor) -> Tensor:
    """How far the norm of ``gradient`` (..., 3) is from 1: the absolute value of its logarithm (...)."""
    norm = torch.linalg.vector_norm(gradient, dim=-1)
    return torch.clamp(norm.clamp_min(1e-9).log().abs(), max=_MOST)


def parts_of_gradient(field: SdfField, points: Tensor) -> PartsOfGradient | None:
    """The parts at points (N, 3) within the cube that the grid covers; None without a grid."""
    function = field.function if isinstance(field, FunctionField) else None
    if isinstance(function, BoxExtension):
        points = torch.minimum(torch.maximum(points, function.low), function.high)
        function = function.function
    if isinstance(function, NeusFactoFunction):
        encoding = function.hash_encoding
    elif isinstance(function, GridMlpFunction):
        encoding = function.encoding
    else:
        return None
    if encoding is None:
        return None
    chunks = [function.gradient_by_level(chunk) for chunk in torch.split(points, _CHUNK)]
    distance, rest, levels = zip(*chunks, strict=True)
    parts = torch.cat(distance), torch.cat(rest), torch.cat(levels, dim=1)
    return PartsOfGradient(*parts, encoding.scales, function.places(points))


def level_gains(rest: Tensor, levels: Tensor) -> Tensor:
    """Each level's gain at each point (A, N); 0 where the level hardly counts."""
    gains = torch.zeros(levels.shape[:2])
    gradient = rest
    for gain, part in zip(gains, levels, strict=True):
        if float(part.norm(dim=-1).mean()) > _LEAST_PART:
            gain.copy_(norm_misfit(gradient - part) - norm_misfit(gradient + part))
        gradient = gradient + part
    return gains


def _in_errors(gain: Tensor, scale: float, places: Tensor) -> Tensor:
    """The mean of one level's gain (N,) in standard errors."""
    across = max(1, int(scale / _BLOCK))
    cell = (places.double() * across).floor().clamp(0, across - 1).long()
    block = torch.unique((cell[:, 0] * across + cell[:, 1]) * across + cell[:, 2], return_inverse=True)[1]
    count = int(block.max()) + 1
    mean = gain.double().mean()
    sums = torch.zeros(count, dtype=torch.float64).index_add_(0, block, gain.double() - mean)
    error = sums.square().sum().sqrt() / len(gain)
    if count < 2 or float(error) == 0.0:
        return torch.zeros(())
    return (mean.sign() * (count * torch.log1p((mean / error).square() / count)).sqrt()).float()

"""What the weights themselves say for a reading: how near the gradient's norm is to 1 where the field is trained.

A grid read by another layout than it was trained with is noise on top of the shape: its gradient is anything but 1. All
readings are evaluated at the same points, so that their differences are told from chance.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import build_field
from regnf_core.fields.neus_facto_function import NeusFactoFunction
from regnf_core.fields.observation import SdfField
from regnf_core.fields.user_fields import FunctionField
from regnf_core.importing.families.converted import Reading
from regnf_core.schema.safe_format import parse_description, tensor_specs

# How much each level of a hash grid does for the gradient's norm: what a level read by another layout cannot do.
#
# A level that is read as it was trained corrects the gradient that the coarser ones leave. Read by another layout its
# part of the gradient is as large and points anywhere: taken away instead of added, it does as well. So the gain is
# the misfit with the level's part subtracted less the misfit with it added, and chance alone makes it 0 whatever the
# level's resolution. Levels are added from the coarsest on: a fine level's noise does not hide what a coarse one
# does.
#
# Points of one cell share the level's entries, so that chance is told from blocks of cells and not from points. A
# level of few cells has few blocks, and so it tells little, however many points there are.

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

    def support(self) -> float:
        """Log likelihood ratio that the levels' gains are more than chance; what speaks against it counts as much."""
        errors = [
            _in_errors(gain, float(scale), self.places) for gain, scale in zip(self.gains, self.scales, strict=True)
        ]
        return 0.5 * sum(error * abs(error) for error in errors)


def norm_misfit(gradient: Tensor) -> Tensor:
    """How far the norm of ``gradient`` (..., 3) is from 1: the absolute value of its logarithm (...)."""
    norm = torch.linalg.vector_norm(gradient, dim=-1)
    return torch.clamp(norm.clamp_min(1e-9).log().abs(), max=_MOST)


def level_gains(rest: Tensor, levels: Tensor) -> Tensor:
    """Each level's gain at each point (A, N); 0 where the level hardly counts."""
    gains = torch.zeros(levels.shape[:2])
    gradient = rest
    for gain, part in zip(gains, levels, strict=True):
        if float(part.norm(dim=-1).mean()) > _LEAST_PART:
            gain.copy_(norm_misfit(gradient - part) - norm_misfit(gradient + part))
        gradient = gradient + part
    return gains


def _in_errors(gain: Tensor, scale: float, places: Tensor) -> float:
    """The mean of one level's gain (N,) in standard errors; of few blocks in those of as much likelihood (Student)."""
    across = max(1, int(scale / _BLOCK))
    cell = (places.double() * across).floor().clamp(0, across - 1).long()
    block = torch.unique((cell[:, 0] * across + cell[:, 1]) * across + cell[:, 2], return_inverse=True)[1]
    count = int(block.max()) + 1
    mean = gain.double().mean()
    sums = torch.zeros(count, dtype=torch.float64).index_add_(0, block, gain.double() - mean)
    error = sums.square().sum().sqrt() / len(gain)
    if count < 2 or float(error) == 0.0:
        return 0.0
    return float(mean.sign() * (count * torch.log1p((mean / error).square() / count)).sqrt())


SAME_SHARE = 9e-4
"""Functions that differ by less than this share of their range are one; wrong is what differs by 1e-3."""


@dataclass(frozen=True)
class Trial:
    """One reading at the points: distances (N,), gradients (N, 3) and misfits (N,), |log| of the gradient's norm.

    levels: what each level of its grid does, see :mod:`level_gains`. None: the reading is no field, or has no grid.
    """

    reading: Reading
    distance: Tensor | None = None
    gradient: Tensor | None = None
    misfit: Tensor | None = None
    levels: LevelGains | None = None

    @cached_property
    def mean(self) -> float:
        """The mean misfit; infinite where the reading is no field."""
        return math.inf if self.misfit is None else float(self.misfit.mean())

    @property
    def misfit_near(self) -> float:
        """The median misfit of the points near the surface, which are the second half."""
        return math.inf if self.misfit is None else float(self.misfit[len(self.misfit) // 2 :].median())

    @cached_property
    def support(self) -> float:
        """What the levels say for the reading against one all of whose levels are noise: a log likelihood ratio."""
        return 0.0 if self.levels is None else self.levels.support()

    @property
    def is_distance(self) -> bool:
        """Whether the gradient's norm is near to 1."""
        return self.mean < _DISTANCE

    @property
    def is_telling(self) -> bool:
        """Whether the levels do clearly more than chance, and the reading is clearly a distance."""
        return self.support > LEAST_SUPPORT and self.is_distance

    def support_over(self, other: Trial) -> float:
        """The same against ``other``: level by level at the same points where both have as many levels."""
        if self.levels is None or other.levels is None or len(self.levels.gains) != len(other.levels.gains):
            return self.support - other.support
        return self.levels.over(other.levels).support()

    def is_better(self, other: Trial, share: float, least: float = 0.0) -> bool:
        """Whether this one fits better than ``other`` by more than chance, ``share`` of its misfit and ``least``."""
        if self.misfit is None or other.misfit is None:
            return other.misfit is None and self.misfit is not None
        more = other.misfit - self.misfit
        mean, error = float(more.mean()), float(more.std()) / math.sqrt(len(more))
        return mean > max(least, share * self.mean) and mean > _DEVIATIONS * error

    def is_same(self, other: Trial) -> bool:
        """Whether both are one function, as far as the points show."""
        if self.distance is None or other.distance is None:
            return self.distance is other.distance
        extent = float(self.distance.max() - self.distance.min())
        return float((self.distance - other.distance).abs().max()) <= SAME_SHARE * extent


LEAST_SUPPORT = 15.0
"""Support is clear beyond so much: a likelihood ratio of three million."""
_DISTANCE = 0.4
"""A reading of a greater mean misfit is itself no distance, and speaks against no other."""
_DEVIATIONS = 4.5
"""A difference counts beyond this many standard errors of its mean."""


class Evidence:
    """Tries readings of one checkpoint at the same points of its bounds: half of them anywhere, half near the surface
    that ``first`` has."""

    def __init__(self, first: Reading, points: int, seed: int = 0) -> None:
        box = torch.tensor(first.description["bounds"], dtype=torch.float32)
        scattered = torch.rand(4 * points, 3, generator=torch.Generator().manual_seed(seed))
        scattered = box[0] + (box[1] - box[0]) * scattered
        nearest = torch.arange(points // 2)
        try:
            distance = field_of(first).signed_distance(scattered[points // 2 :])
            nearest = distance.abs().nan_to_num(math.inf).argsort()
        except FieldFormatError:
            pass
        near = scattered[points // 2 :][nearest[: points // 2]]
        self._points = torch.cat((scattered[: points // 2], near))

    def of(self, reading: Reading) -> Trial:
        """The reading's trial; an empty one where the description is beyond what a field may have."""
        try:
            field = field_of(reading)
            distance, gradient, levels = _evaluated(field, self._points)
        except FieldFormatError:
            return Trial(reading)
        if not torch.isfinite(distance).all() or not torch.isfinite(gradient.norm(dim=-1)).all():
            return Trial(reading)
        return Trial(reading, distance, gradient, norm_misfit(gradient), levels)


def _evaluated(field: SdfField, points: Tensor) -> tuple[Tensor, Tensor, LevelGains | None]:
    """Distance, gradient, and what the levels do where there is a grid."""
    function = field.function if isinstance(field, FunctionField) else None
    if not isinstance(function, NeusFactoFunction) or function.hash_encoding is None:
        return *field.signed_distance_and_gradient(points), None
    chunks = [function.gradient_by_level(chunk) for chunk in torch.split(points, _CHUNK)]
    parts = zip(*chunks, strict=True)  # (N,), (N, 3) and (A, N, 3)
    distance, rest, levels = (torch.cat(part, dim=max(0, part[0].dim() - 2)) for part in parts)
    gains = LevelGains(level_gains(rest, levels), function.hash_encoding.scales, function.places(points))
    return distance, rest + levels.sum(dim=0), gains


def field_of(reading: Reading) -> SdfField:
    """Raises FieldFormatError where it is no field: a factor beyond what a field may have, for example."""
    description = parse_description(reading.description)
    description.check(tensor_specs(reading.tensors))
    with warnings.catch_warnings():
        # the map of the upload is only read
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        tensors = {name: torch.from_numpy(array) for name, array in reading.tensors.items()}
    return build_field(description, tensors)

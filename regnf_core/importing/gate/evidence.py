"""What the weights themselves say for a reading: how near the gradient's norm is to 1 where the field is trained.

A grid read by another layout than it was trained with is noise on top of the shape: its gradient is anything but 1. All
readings are evaluated at the same points, so that their differences are told from chance.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.base import SdfField
from regnf_core.fields.build import build_field
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.gate.level_gains import LevelGains, norm_misfit, parts_of_gradient
from regnf_core.schema.parsing import parse_description

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

    @property
    def mean(self) -> float:
        """The mean misfit; infinite where the reading is no field."""
        return math.inf if self.misfit is None else float(self.misfit.mean())

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

    def has_levels_of(self, other: Trial) -> bool:
        """Whether both divide the table into as many levels, so that these can be compared one by one."""
        if self.levels is None or other.levels is None:
            return self.levels is other.levels
        return len(self.levels.gains) == len(other.levels.gains)

    def has_resolutions_of(self, other: Trial) -> bool:
        """Whether both differ at most in how rows are counted, or have no grid: misread, they are equally noisy.

        Over another cube the cells have another length, and a misread grid another noise.
        """
        if self.levels is None or other.levels is None:
            return self.levels is other.levels
        radii = (trial.reading.description.get("grid_radius") for trial in (self, other))
        return len(set(radii)) == 1 and torch.equal(self.levels.scales, other.levels.scales)

    def support_over(self, other: Trial) -> float:
        """The same against ``other``: level by level at the same points where both have as many levels."""
        if self.levels is None or other.levels is None or not self.has_levels_of(other):
            return self.support - other.support
        return self.levels.over(other.levels).support()

    def usual_over(self, other: Trial) -> float:
        """What usual numbers say for this reading against ``other``, as support. Strides are not anybody's numbers."""
        if self.has_resolutions_of(other):
            return 0.0
        tiers = other.reading.tier - self.reading.tier
        mine, others = self.reading.scale, other.reading.scale
        if tiers and mine is not None and others is not None and abs(mine - others) < _ACCIDENT:
            return math.copysign(LEAST_SUPPORT + _USUAL, tiers)
        return _USUAL * tiers

    def beats(self, other: Trial) -> bool:
        """Whether the levels speak clearly for this reading and not for ``other``.

        The misfit alone speaks only where both have the same resolutions: a misread grid of low resolution has less of
        it than the right one. Readings of other numbers of levels have no levels in common: then more must speak for
        this one. A reading without a grid is the simplest one: it stands where a grid's levels say nothing and only
        worsen the misfit.
        """
        if other.misfit is None:
            return self.misfit is not None
        if self.levels is None and other.levels is not None:
            return other.support < LEAST_SUPPORT and self.is_better(other, CLEARLY, LEAST)
        if self.has_resolutions_of(other) and self.is_better(other, CLEARLY, LEAST):
            return True
        if self.has_levels_of(other):
            return self.support_over(other) + self.usual_over(other) > _LIKELIER
        return self.support_over(other) > CLEAR_SUPPORT

    def is_better(self, other: Trial, share: float, least: float = 0.0) -> bool:
        """Whether this one fits better than ``other`` by more than chance, ``share`` of its misfit and ``least``."""
        if self.misfit is None or other.misfit is None:
            return other.misfit is None and self.misfit is not None
        more = other.misfit - self.misfit
        error = float(more.std()) / math.sqrt(len(more))
        mean = float(more.mean())
        return mean > max(least, share * self.mean) and mean > _DEVIATIONS * error

    def is_same(self, other: Trial) -> bool:
        """Whether both are one function, as far as the points show."""
        if self.distance is None or other.distance is None:
            return self.distance is other.distance
        extent = float(self.distance.max() - self.distance.min())
        return float((self.distance - other.distance).abs().max()) <= SAME_SHARE * extent


LEAST_SUPPORT = 15.0
"""Support is clear beyond so much: a likelihood ratio of three million."""
_LIKELIER = 10.0
"""What a reading needs against one of as many levels, usual numbers included: odds of twenty thousand. Levels that tell
nothing add 3 to it by chance (the standard deviation of twelve)."""
_USUAL = 5.0
"""A tier of numbers is written this much more often than the next: 150 times, as a logarithm."""
_ACCIDENT = 0.01
"""Logarithm of finest resolutions within which a more usual number is no accident."""
CLEAR_SUPPORT = 50.0
"""What two readings need whose difference chance is not all of: readings of other levels, interpolations, nothing."""
_DISTANCE = 0.4
"""A reading of a greater mean misfit is itself no distance, and speaks against no other."""
CLEARLY, LEAST = 0.1, 0.01
"""A misfit is clearly greater by this share of the other's, and by this much at least."""
_DEVIATIONS = 4.5
"""A difference counts beyond this many standard errors of its mean."""


class Evidence:
    """Tries readings of one checkpoint at the same points of its bounds: half of them anywhere, half near the surface
    that ``first`` has."""

    def __init__(self, first: Reading, points: int, seed: int = 0) -> None:
        box = torch.tensor(first.description["bounds"], dtype=torch.float32)
        scattered = torch.rand(4 * points, 3, generator=torch.Generator().manual_seed(seed))
        scattered = box[0] + (box[1] - box[0]) * scattered
        field = _field(first.description, first.tensors)
        nearest = torch.arange(points // 2)
        if field is not None:
            nearest = field.signed_distance(scattered[points // 2 :]).abs().nan_to_num(math.inf).argsort()
        near = scattered[points // 2 :][nearest[: points // 2]]
        self._points = torch.cat((scattered[: points // 2], near))

    def of(self, reading: Reading) -> Trial:
        """The reading's trial."""
        field = _field(reading.description, reading.tensors)
        if field is None:
            return Trial(reading)
        try:
            distance, gradient, levels = self._evaluate(field)
        except FieldFormatError:
            return Trial(reading)
        if not torch.isfinite(distance).all() or not torch.isfinite(gradient.norm(dim=-1)).all():
            return Trial(reading)
        return Trial(reading, distance, gradient, norm_misfit(gradient), levels)

    def _evaluate(self, field: SdfField) -> tuple[Tensor, Tensor, LevelGains | None]:
        """Distance, gradient, and what the levels do where there is a grid."""
        parts = parts_of_gradient(field, self._points)
        if parts is None:
            return *field.signed_distance_and_gradient(self._points), None
        return parts.distance, parts.rest + parts.levels.sum(dim=0), parts.gains()


def _field(description: dict[str, Any], tensors: Mapping[str, StoredArray]) -> SdfField | None:
    """The field, or None where the description is beyond what a field may have."""
    try:
        with _read_only():
            named = {name: torch.from_numpy(array) for name, array in tensors.items()}
        return build_field(parse_description(description), named)
    except FieldFormatError:
        return None


@contextmanager
def _read_only() -> Iterator[None]:
    """The map of the upload is only read: torch need not say that it could not be written to."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        yield

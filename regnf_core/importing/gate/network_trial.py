"""How much a network, read in one of several ways, behaves like a signed distance: measured at few points.

A step from a point along the gradient, as long as the distance there says, ends on the surface. Where it does not, the
reading is another one than the network was trained with, or the network was never trained there.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.base import SdfField
from regnf_core.importing.families.converted import Reading
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.importing.gate.reading_field import field_of

QUICK_SAMPLES, SAMPLES, COMPARED = 256, 2048, 1024
_PARTS = (1, 2, 8)
"""Of all points those nearest to the surface: all of them, a half, an eighth."""
_FEWEST = 12
_CONE = 0.9


@dataclass(frozen=True)
class Trial:
    """A reading, built; ``field`` is None if it cannot be, or if its values are not finite.

    misses: by how much of their length steps to the surface miss it, mean, from 0 to 1: of all points, then of those
    ever nearer to the surface. Infinite where too few steps stay within the bounds.
    """

    reading: Reading
    field: SdfField | None
    misses: tuple[float, ...]

    @property
    def overall(self) -> float:
        """One number to sort by: the geometric mean."""
        return math.prod(self.misses) ** (1.0 / len(self.misses))


@without_new_code()
def tried(reading: Reading, samples: int, known_to: float | None) -> Trial:
    """known_to: distances beyond which the trainer leaves values to themselves, if there are such."""
    none = Trial(reading, None, (math.inf,) * len(_PARTS))
    field = _built(reading)
    if field is None:
        return none
    points = _in_bounds(field, samples)
    distance, gradient = field.signed_distance_and_gradient(points)
    if not (torch.isfinite(distance).all() and torch.isfinite(gradient.norm(dim=-1)).all()):
        return none
    length = gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    ends = points - distance[:, None] * gradient / length
    low, high = field.bounds[0].float(), field.bounds[1].float()
    within = ((ends >= low) & (ends <= high)).all(dim=-1)
    missed = field.signed_distance(ends).abs() / distance.abs().clamp_min(1e-9)
    missed = missed.nan_to_num(1.0).clamp_max(1.0)
    if known_to is not None:
        within &= distance.abs() < known_to
    order = distance.abs().argsort()
    return Trial(reading, field, tuple(_mean(missed, order[: samples // part], within) for part in _PARTS))


def _mean(missed: Tensor, part: Tensor, counted: Tensor) -> float:
    kept = missed[part][counted[part]]
    return float(kept.mean()) if len(kept) >= _FEWEST else math.inf


@without_new_code()
def end_of_training(field: SdfField) -> tuple[float, float]:
    """The radius beyond which the gradient's length is no longer 1, along the axes, and how clearly it ends there.

    Clearly: the least misfit in the shells beyond, over the greatest in those within.
    """
    edges = 0.25 * 1.08 ** torch.arange(46)
    generator = torch.Generator().manual_seed(3)
    misfits = []
    for low, high in itertools.pairwise(edges):
        direction = torch.randn(600, 3, generator=generator)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        direction = direction[direction.abs().amax(dim=-1) > _CONE]
        radius = low + (high - low) * torch.rand(len(direction), 1, generator=generator)
        lengths = field.signed_distance_and_gradient(radius * direction)[1].norm(dim=-1)
        misfits.append(float((lengths - 1.0).abs().median()))
    within, beyond = 4, 6
    contrast = {
        float(edges[i]): min(misfits[i + 1 : i + beyond]) / max(1e-4, *misfits[i - within : i])
        for i in range(within, len(misfits) - beyond)
    }
    radius = max(contrast, key=contrast.__getitem__)
    return radius, contrast[radius]


@without_new_code()
def values_differ(one: SdfField, other: SdfField, share: float) -> bool:
    """Whether the two fields' values differ by more than ``share`` of their range, within the first one's bounds."""
    points = _in_bounds(one, COMPARED)
    a, b = one.signed_distance(points), other.signed_distance(points)
    return bool((a - b).abs().max() > share * (a.max() - a.min()))


def _built(reading: Reading) -> SdfField | None:
    try:
        return field_of(reading)
    except FieldFormatError:
        return None


def _in_bounds(field: SdfField, count: int) -> Tensor:
    low, high = field.bounds[0].float(), field.bounds[1].float()
    return low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(1))

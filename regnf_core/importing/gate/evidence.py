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
from typing import Any

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.base import SdfField
from regnf_core.fields.build import build_field
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.families.converted import Reading
from regnf_core.schema.parsing import parse_description

SAME_SHARE = 9e-4
"""Functions that differ by less than this share of their range are one; wrong is what differs by 1e-3."""
_MOST = 3.0
"""Beyond this, the logarithm of the gradient's norm says no more."""


@dataclass(frozen=True)
class Trial:
    """One reading at the points: distances (N,), gradients (N, 3) and misfits (N,), |log| of the gradient's norm.

    None: the reading is no field.
    """

    reading: Reading
    distance: Tensor | None = None
    gradient: Tensor | None = None
    misfit: Tensor | None = None

    @property
    def mean(self) -> float:
        """The mean misfit; infinite where the reading is no field."""
        return math.inf if self.misfit is None else float(self.misfit.mean())

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
            distance, gradient = field.signed_distance_and_gradient(self._points)
        except FieldFormatError:
            return Trial(reading)
        norm = gradient.norm(dim=-1)
        if not torch.isfinite(distance).all() or not torch.isfinite(norm).all():
            return Trial(reading)
        return Trial(reading, distance, gradient, norm.clamp_min(1e-9).log().abs().clamp_max(_MOST))


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

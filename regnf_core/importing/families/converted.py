"""What a family makes of a checkpoint."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.importing.arrays import StoredArray
from regnf_core.schema.description import FREE, OBSERVATION, UNSEEN, ObservationGrid


@dataclass(frozen=True)
class Reading:
    """One function that a checkpoint's tensors may stand for: the safe file's description and tensors."""

    name: str
    """A few words that distinguish it from the other readings."""
    description: dict[str, Any]
    tensors: Mapping[str, StoredArray]
    say: dict[str, Any] = field(default_factory=dict)
    """The entries of an upload's description that choose it."""
    tier: int = 0
    """How usual it is: 0 before all others. Of readings that fit alike, one of a lower number is taken."""
    interpolation: Literal["known", "open"] = "known"
    """How a grid is interpolated: said or the only way of the family, or asked unless the weights tell."""
    scale: float | None = None
    """Natural logarithm of the finest resolution: how far two layouts are apart."""

    def is_grid_of(self, other: Reading) -> bool:
        """Whether both have the same grid, but for the growth's last digits."""
        mine, others = (dict(reading.description.get("hash") or {}) for reading in (self, other))
        growths = mine.pop("per_level_scale", 0.0), others.pop("per_level_scale", 0.0)
        return mine == others and math.isclose(*growths, rel_tol=1e-9)


@dataclass(frozen=True)
class OpenReading:
    """A reading that is made only when it is tried: there may be many, and each has tensors of its own."""

    name: str
    """What to say in a description to get it."""
    family: str
    make: Callable[[], Reading]
    ends_at: float | None = None
    """The radius beyond which the trainer never looks, in the field's own coordinates, where it is known."""
    known_to: float | None = None
    """The distance beyond which the trainer leaves values to themselves, where it is known."""
    nearby: tuple[Callable[[], Reading], ...] = ()
    """Readings a little off this one, which behave less well if it is the right one of a family of many."""


@dataclass(frozen=True)
class Variant:
    """Another function of the same tensors. say: the entries of a description that choose it · of: makes it of the
    reading that is chosen otherwise."""

    name: str
    say: dict[str, Any]
    of: Callable[[Reading], Reading]


@dataclass(frozen=True)
class ConvertedField:
    """A field ready to be written: the safe file's description and tensors, and how the family was recognized."""

    family: str
    why: tuple[str, ...]
    """The evidence, one short sentence each."""
    description: dict[str, Any]
    tensors: Mapping[str, StoredArray]
    warnings: tuple[str, ...] = ()
    readings: tuple[Reading, ...] = ()
    """Where shapes leave the function open: every possible one, the most usual first. The gate tries them and keeps the
    one that behaves most like a distance; see :mod:`regnf_core.importing.gate.choice`. Empty: there is no doubt."""
    open_readings: tuple[OpenReading, ...] = ()
    """The same where what decides is how a network of plain layers behaves; see
    :mod:`regnf_core.importing.gate.network_form`."""
    untold: tuple[Variant, ...] = ()
    """Functions between which no behavior decides: a person is asked, once the readings are settled."""
    sign_is_open: bool = False
    """Whether trainers of this family save fields of either sign, and the upload does not say which this is."""


def converted_of(
    family: str, why: tuple[str, ...], readings: tuple[Reading, ...], warnings: tuple[str, ...] = ()
) -> ConvertedField:
    """The field of the first of one or more readings, the others to be tried."""
    first = readings[0]
    doubtful = readings if len(readings) > 1 or first.interpolation != "known" else ()
    return ConvertedField(family, why, first.description, first.tensors, warnings, doubtful)


def observed_field(
    field: ConvertedField, grid: ObservationGrid, words: npt.NDArray[np.int32], told: str
) -> ConvertedField:
    """The field with an observation. grid: of its kind's coordinates · words: the states as ``grid.pack`` gives them ·
    told: what it is made from."""
    states = np.bincount(grid.unpack(words).ravel(), minlength=3) / grid.voxels
    told = f"observed {told}: {100 * states[FREE]:.0f} % of the volume is free, {100 * states[UNSEEN]:.0f} % unobserved"
    changed = {**field.description, OBSERVATION: asdict(grid)}
    tensors = {**field.tensors, OBSERVATION: words}
    return replace(field, description=changed, tensors=tensors, why=(*field.why, told))

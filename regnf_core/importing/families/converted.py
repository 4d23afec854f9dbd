"""What a family makes of a checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from regnf_core.errors import MOST_CANDIDATES, FieldFormatError
from regnf_core.importing.arrays import StoredArray
from regnf_core.importing.assumptions import UNSAID, Assumptions
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
class Variant:
    """Another function of the same tensors. say: the entries of a description that choose it · of: makes it of the
    reading that is chosen otherwise."""

    name: str
    say: dict[str, Any]
    of: Callable[[Reading], Reading]


@dataclass(frozen=True)
class Assumed:
    """A number that no tensor tells: the usual one is taken if the field then behaves like a distance.

    say: the entries of a description that give it · beside: readings with the number a little off, which behave less
    well if it is right · others: what else it usually is.
    """

    say: dict[str, Any]
    beside: tuple[Callable[[], Reading], ...] = ()
    others: tuple[Variant, ...] = ()


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
    """Where shapes leave the function open: every possible one, the most usual first. The importer tries them and keeps
    the one that behaves most like a distance; see :mod:`regnf_core.importing.gate.choice`. Empty: there is no doubt."""
    assumed: Assumed | None = None
    untold: tuple[Variant, ...] = ()
    """Functions between which no behavior decides: a person is asked, once the readings are settled."""
    sign_is_open: bool = False
    """Whether trainers of this family save fields of either sign, and the upload does not say which this is."""
    assumes: Assumptions = UNSAID
    """What the file does not say and was taken for granted; see :mod:`regnf_core.importing.assumptions`."""

    @property
    def reading(self) -> Reading:
        """The function as it is now."""
        return Reading(self.family, self.description, self.tensors)


@dataclass(frozen=True)
class OpenCandidate:
    """name: what distinguishes it · say: the entries of a description that choose it · make: gives its function."""

    name: str
    say: dict[str, Any]
    make: Callable[[], Reading] = field(repr=False)


class AmbiguousError(FieldFormatError):
    """The evidence leaves several functions; ``asked`` holds those that are shown, the most probable first."""

    reason = "LAYOUT_AMBIGUOUS"

    def __init__(self, message: str, asked: Sequence[OpenCandidate]) -> None:
        super().__init__(message)
        lines: dict[str, OpenCandidate] = {}
        for one in asked:
            if one.say:
                lines.setdefault(json.dumps(one.say, sort_keys=True), one)
        self.asked = tuple(lines.values())[:MOST_CANDIDATES]


def untold_error(converted: ConvertedField, variants: Sequence[Variant], what: str) -> AmbiguousError:
    """The refusal of a field that is one of ``variants``, because of ``what``."""
    asked = [OpenCandidate(one.name, one.say, partial(one.of, converted.reading)) for one in variants]
    lines = " or ".join(json.dumps(one.say) for one in asked[:MOST_CANDIDATES])
    return AmbiguousError(f"{what}; add to the import options {lines}", asked)


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

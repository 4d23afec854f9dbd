"""Which form a network of plain layers has, where neither its tensors nor the description say: by how it behaves.

The values of a network that was trained to be a distance are distances to its zero level: a step along the gradient, as
long as the value, ends there. Read in another way than it was trained it does not. Of networks that are alike in that
the radius decides at which training ended. What none of this decides is refused with what to say.
"""

from __future__ import annotations

import heapq
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from regnf_core.errors import FieldFormatError
from regnf_core.fields.observation import SdfField
from regnf_core.importing.cost.mesh_work import Calls
from regnf_core.importing.families.converted import ConvertedField, OpenReading, Reading
from regnf_core.importing.gate.cost_estimate import seconds_of
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.importing.gate.reading_field import field_of
from regnf_core.importing.gate.readings_beside import AmbiguousError, OpenCandidate

# How much a network, read in one of several ways, behaves like a signed distance: measured at few points.
#
# A step from a point along the gradient, as long as the distance there says, ends on the surface. Where it does not,
# the reading is another one than the network was trained with, or the network was never trained there.

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


_SAME = 1e-3
"""Readings whose values differ by less than this share of their range are one."""
_DISTANCE_LIKE = 0.1
"""By how much of their length steps to the surface may miss it, in the mean, where a network was trained."""
_CLEARLY = 2.0
"""So many times as much must those of another reading miss it, for that one to be left out."""
_BETTER = 0.9
"""So much less missed by a reading near another one says that the other is not right."""
_FINALISTS = 8
_SHOWN = 4
_SHARP_END = 2.5
_END = (0.88, 1.22)
"""Where training ends, of the radius that the trainer keeps to; beyond the sphere it looks a little further."""
_TRIALS_S = 10.0
"""Seconds of one core for all quick trials; the readings beyond them are not tried, which refuses a network."""


@dataclass(frozen=True)
class _Candidate:
    open: OpenReading
    trial: Trial

    @property
    def field(self) -> SdfField:
        if self.trial.field is None:
            raise ValueError("a reading that cannot be evaluated has no field")
        return self.trial.field

    @cached_property
    def improvable(self) -> bool:
        """Whether it behaves better where a number that may be any is a little off."""
        near = (tried(make(), SAMPLES, self.open.known_to).overall for make in self.open.nearby)
        return any(overall < _BETTER * self.trial.overall for overall in near)


def settle_form(converted: ConvertedField) -> ConvertedField:
    """``converted`` with the one reading that behaves as a distance, and in ``why`` by which evidence.

    Raises AmbiguousError: several readings that differ do, or none. FieldFormatError (FIELD_NOT_FINITE).
    """
    readings = _affordable(converted)
    finalists = _finalists(readings)
    if not finalists:
        raise FieldFormatError("values and gradients are finite in none of its readings", reason="FIELD_NOT_FINITE")
    if not any(min(one.trial.misses) < _DISTANCE_LIKE for one in finalists):
        raise _undecided(_as_candidates(readings), "none behaves like a distance")
    ends = any(one.open.ends_at is not None for one in finalists)
    chosen, how, *warnings = _by_end(finalists) if ends else _by_misses(finalists)
    if len(readings) < len(converted.open_readings):
        raise _undecided([chosen], "the network is too large to try all")
    if chosen.improvable:
        raise _undecided([chosen], "others near the usual ones behave better")
    reading = chosen.open.make()
    why = f"{chosen.open.name}: {how}; {len(converted.open_readings)} readings were tried"
    return replace(
        converted,
        family=chosen.open.family,
        why=(*converted.why, why),
        description=reading.description,
        tensors=reading.tensors,
        warnings=(*converted.warnings, *warnings),
        open_readings=(),
    )


def _affordable(converted: ConvertedField) -> Sequence[OpenReading]:
    """As many of the readings as may be tried in the time there is, the most usual first."""
    each, full = (
        seconds_of(converted.description, dict(converted.tensors), Calls((samples,), (samples,)))
        for samples in (QUICK_SAMPLES, SAMPLES)
    )
    left = _TRIALS_S - min(_FINALISTS, len(converted.open_readings)) * full
    return converted.open_readings[: max(1, int(left / each))]


def _finalists(readings: Sequence[OpenReading]) -> list[_Candidate]:
    """The best of all after a quick trial, tried fully, the best first."""
    chosen = list(readings)
    if len(readings) > _FINALISTS:
        chosen = heapq.nsmallest(
            _FINALISTS, readings, key=lambda one: tried(one.make(), QUICK_SAMPLES, one.known_to).overall
        )
    made = [_Candidate(one, tried(one.make(), SAMPLES, one.known_to)) for one in chosen]
    return sorted((one for one in made if one.trial.field is not None), key=lambda one: one.trial.overall)


def _by_misses(finalists: list[_Candidate]) -> tuple[_Candidate, str]:
    """By how far steps to the surface miss it: of all points, or only of those nearer to it, if one is clearly best.

    A reading that misses it less with another factor than its own is not the right one: that one was trained with its
    own.
    """
    for part in range(len(finalists[0].trial.misses)):
        best = min(finalists, key=lambda one: one.trial.misses[part])
        least = best.trial.misses[part]
        others = [one for one in finalists if values_differ(best.field, one.field, _SAME)]
        if least > _DISTANCE_LIKE or any(_much_better(one, best) for one in others):
            continue
        alike = [one for one in others if one.trial.misses[part] < _CLEARLY * least]
        if all(one.improvable for one in alike):
            next_best = min((one.trial.misses[part] for one in others), default=math.inf)
            how = f"steps to the surface miss it by {least:.3f} of their length in the mean"
            return best, how if math.isinf(next_best) else f"{how}, in the next reading by {next_best:.3f}"
    raise _undecided(finalists, "they behave alike")


def _much_better(one: _Candidate, other: _Candidate) -> bool:
    """Whether it is in any part of the points."""
    return any(_CLEARLY * a < b for a, b in zip(one.trial.misses, other.trial.misses, strict=True))


def _by_end(candidates: list[_Candidate]) -> tuple[_Candidate, str, str]:
    """By where training ended. Nothing else tells a network from itself at another scale: the gradient is as long at
    each. The trainer looks a little farther or less far, so scales near the one that is taken would look alike."""
    fitting = []
    for one in candidates:
        radius, contrast = end_of_training(one.field)
        ratio = radius / (one.open.ends_at or math.inf)
        trained = min(one.trial.misses) < _DISTANCE_LIKE
        if trained and contrast >= _SHARP_END and _END[0] <= ratio <= _END[1]:
            how = f"the gradient's length is 1 up to a radius of {radius:.2f} and not beyond"
            alike = f"{ratio / _END[1]:.2f} to {ratio / _END[0]:.2f}"
            warning = (
                f"SCALE_ASSUMED: {one.open.name} is taken, as published; where training ended fits {alike} times it"
            )
            fitting.append((one, how, f"{warning} as well, and lengths would be off by as much: say the trainer's own"))
    if len(fitting) != 1:
        raise _undecided(candidates, "where training ended does not show")
    return fitting[0]


def _as_candidates(readings: Sequence[OpenReading]) -> list[_Candidate]:
    return [_Candidate(one, Trial(one.make(), None, ())) for one in readings[:_SHOWN]]


def _undecided(candidates: Sequence[_Candidate], what: str) -> AmbiguousError:
    names = " or ".join(one.open.name for one in candidates[:_SHOWN])
    more = f" (of {len(candidates)})" if len(candidates) > _SHOWN else ""
    message = f"the tensors leave open which function this is, and {what}; say {names}{more} in the description"
    asked = [one.open for one in candidates if one.open.name.startswith("{")]
    return AmbiguousError(message, [OpenCandidate(_words(one.name), json.loads(one.name), one.make) for one in asked])


def _words(told: str) -> str:
    """Entries of a description, as JSON, without its signs."""
    return "".join(c for c in told if c not in '{}"')

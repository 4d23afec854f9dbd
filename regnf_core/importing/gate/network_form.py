"""Which form a network of plain layers has, where neither its tensors nor the description say: by how it behaves.

A network that was trained to be a distance has a gradient of length one near its surface; read in another way than it
was trained it has not. Readings that agree there are told apart by their values farther off, and by the radius at which
training ended. What none of this decides is refused with what to say.
"""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from regnf_core.fields.base import SdfField
from regnf_core.importing.cost.calls import Calls
from regnf_core.importing.families.converted import ConvertedField, OpenReading
from regnf_core.importing.gate.ambiguity import AmbiguousError, OpenCandidate
from regnf_core.importing.gate.cost_estimate import seconds_of
from regnf_core.importing.gate.network_trial import (
    QUICK_SAMPLES,
    SAMPLES,
    Trial,
    distance_errors,
    end_of_training,
    full_trial,
    quick_trial,
    values_differ,
)

_SAME = 1e-3
"""Readings whose values differ by less than this share of their range are one."""
_DISTANCE_LIKE = 0.15
"""Greatest misfit of the gradient's length that a network trained to be a distance has."""
_CLEARLY = 1.5
"""So many times the best one's misfit, or error of values, must another reading's be to be left out."""
_MARGIN = 0.03
"""And greater by this."""
_BETTER = 0.97
"""So much less misfit of a reading near the chosen one says that neither is right."""
_TRUE, _MUCH = 0.05, 2.5
"""Greatest error of values that were trained on distances, and how many times that of another reading must be."""
_FINALISTS = 8
_SHOWN = 4
_SHARP_END = 2.5
_END = (0.88, 1.35)
"""Where training ends, of the radius that the trainer keeps to; beyond the sphere it looks a little further."""
_TRIALS_S = 10.0
"""Seconds of one core for all quick trials; the readings beyond them are not tried, which refuses a network."""


@dataclass(frozen=True)
class _Candidate:
    open: OpenReading
    trial: Trial

    @property
    def misfit(self) -> float:
        return self.trial.misfit

    @property
    def field(self) -> SdfField:
        if self.trial.field is None:
            raise ValueError("a reading that cannot be evaluated has no field")
        return self.trial.field


def settle_form(converted: ConvertedField) -> ConvertedField:
    """``converted`` with the one reading that behaves as a distance, and in ``why`` by which evidence.

    Raises AmbiguousError: several readings that differ do, or none.
    """
    tried = _affordable(converted)
    finalists = _finalists(tried)
    if not finalists or finalists[0].misfit > _DISTANCE_LIKE:
        raise _undecided(finalists or _as_candidates(tried), "none has a gradient of length 1 near its surface")
    chosen, how = _decided(finalists)
    if len(tried) < len(converted.open_readings):
        raise _undecided([chosen], "the network is too large to try all")
    if any(full_trial(quick_trial(make())).misfit < _BETTER * chosen.misfit for make in chosen.open.nearby):
        raise _undecided([chosen], "others near the usual ones behave better")
    reading = chosen.open.make()
    why = f"{chosen.open.name}: {how}; {len(converted.open_readings)} readings were tried"
    return replace(
        converted,
        family=chosen.open.family,
        why=(*converted.why, why),
        description=reading.description,
        tensors=reading.tensors,
        open_readings=(),
    )


def _affordable(converted: ConvertedField) -> Sequence[OpenReading]:
    """As many of the readings as may be tried in the time there is, the most usual first."""
    calls = Calls((QUICK_SAMPLES,), (QUICK_SAMPLES // 8,))
    full = Calls((SAMPLES, SAMPLES), (SAMPLES // 8,) * 10)
    each = seconds_of(converted.description, dict(converted.tensors), calls)
    finals = min(_FINALISTS, len(converted.open_readings))
    left = _TRIALS_S - finals * seconds_of(converted.description, dict(converted.tensors), full)
    return converted.open_readings[: max(1, int(left / each))]


def _finalists(readings: Sequence[OpenReading]) -> list[_Candidate]:
    """The best of all after a quick trial, tried fully, the best first."""
    quick = ((quick_trial(one.make()).misfit, number) for number, one in enumerate(readings))
    best = heapq.nsmallest(_FINALISTS, quick) if len(readings) > _FINALISTS else list(quick)
    made = [_Candidate(readings[number], full_trial(quick_trial(readings[number].make()))) for _, number in best]
    return sorted((one for one in made if one.trial.field is not None), key=lambda one: one.misfit)


def _decided(finalists: list[_Candidate]) -> tuple[_Candidate, str]:
    best = finalists[0]
    if any(one.open.ends_at is not None for one in finalists):
        return _by_end(finalists)
    limit = max(_CLEARLY * best.misfit, best.misfit + _MARGIN)
    rivals = _different([one for one in finalists if one.misfit <= limit])
    how = f"the gradient's length near the surface differs from 1 by {best.misfit:.3f} in the mean"
    others = [one.misfit for one in finalists if one.misfit > limit]
    if others:
        how += f", in the next reading by {min(others):.3f}"
    return (rivals[0], how) if len(rivals) == 1 else _by_values(rivals)


def _different(candidates: list[_Candidate]) -> list[_Candidate]:
    """Without those that give the values of one before."""
    kept: list[_Candidate] = []
    for one in candidates:
        if all(values_differ(other.field, one.field, _SAME) for other in kept):
            kept.append(one)
    return kept


def _by_end(candidates: list[_Candidate]) -> tuple[_Candidate, str]:
    """By where training ended. Nothing else tells a network from itself at another scale."""
    fitting = []
    for one in candidates:
        radius, contrast = end_of_training(one.field)
        ratio = radius / (one.open.ends_at or math.inf)
        if contrast >= _SHARP_END and _END[0] <= ratio <= _END[1]:
            fitting.append((one, f"the gradient's length is 1 up to a radius of {radius:.2f} and not beyond"))
    if len(fitting) != 1:
        raise _undecided(candidates, "where training ended does not show")
    return fitting[0]


def _by_values(rivals: list[_Candidate]) -> tuple[_Candidate, str]:
    """By how well values agree with distances to the zero level, at some reach."""
    errors = [distance_errors(one.field) for one in rivals]
    for reach in range(len(errors[0])):
        ranked = sorted((found[reach], number) for number, found in enumerate(errors))
        (best, winner), (second, _) = ranked[0], ranked[1]
        if best < _TRUE and second > max(_MUCH * best, best + _MARGIN):
            how = f"its values differ from distances to its surface by {best:.3f} of them, the next by {second:.3f}"
            return rivals[winner], how
    raise _undecided(rivals, "they behave alike")


def _as_candidates(readings: Sequence[OpenReading]) -> list[_Candidate]:
    return [_Candidate(one, Trial(one.make(), None, 1.0)) for one in readings[:_SHOWN]]


def _undecided(candidates: Sequence[_Candidate], what: str) -> AmbiguousError:
    names = " or ".join(one.open.name for one in candidates[:_SHOWN])
    more = f" (of {len(candidates)})" if len(candidates) > _SHOWN else ""
    message = f"the tensors leave open which function this is, and {what}; say {names}{more} in the description"
    asked = [one.open for one in candidates if one.open.name.startswith("{")]
    return AmbiguousError(message, [OpenCandidate(_words(one.name), json.loads(one.name), one.make) for one in asked])


def _words(told: str) -> str:
    """Entries of a description, as JSON, without its signs."""
    return "".join(c for c in told if c not in '{}"')

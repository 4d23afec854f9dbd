"""Which of several functions a checkpoint's tensors stand for, by evidence from the weights; else it is asked.

The reading is taken whose gradient's norm is clearly nearest to 1, unless the grid's levels speak against it. What
stays open is refused, with the line to add to the description for each.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from regnf_core.errors import MOST_CANDIDATES, FieldFormatError
from regnf_core.importing.cost.mesh_work import (
    FINAL_POINTS,
    FINALISTS,
    LAST_POINTS,
    MAX_TRIED,
    TRIAL_POINTS,
)
from regnf_core.importing.families.converted import (
    AmbiguousError,
    Assumed,
    ConvertedField,
    OpenCandidate,
    Reading,
    Variant,
    untold_error,
)
from regnf_core.importing.gate.evidence import LEAST_SUPPORT, Evidence, Trial
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.schema.hash_grid_config import Interpolation

_CLEARLY, _LEAST = 0.1, 0.01
"""A misfit is clearly greater by this share of the other's, and by this much at least."""
_FINALLY = 0.04
"""In the second round, at more points, a reading is out that fits worse by this share of the best's misfit."""
_ACCIDENT = 0.5 * math.log(2.0)
"""Usual numbers are powers of two: among layouts spread by less than this (log of the finest resolution), one of them
is no accident."""
_CLEAR_SUPPORT = 50.0
"""What readings over different cubes need, whose difference chance is not all of."""
_KINDS: tuple[Interpolation, Interpolation] = ("linear", "smoothstep")


@without_new_code()
def settled(converted: ConvertedField, share: int = 1) -> ConvertedField:
    """``converted`` as the one function that its weights speak for, with what was decided, and by what, in ``why``.

    share: after the first around the readings are tried at one ``share``-th of the points.

    Raises AmbiguousError: readings that differ fit alike.
    """
    if converted.readings:
        chosen, why = _choose(converted.readings, share)
        converted = replace(
            converted,
            why=(*converted.why, *why),
            description=chosen.description,
            tensors=chosen.tensors,
            readings=(),
        )
    return converted if converted.assumed is None else _confirmed(converted, converted.assumed)


def _confirmed(converted: ConvertedField, assumed: Assumed) -> ConvertedField:
    """``converted`` if it behaves like a distance at its surface, and better than with the number a little off."""
    evidence = Evidence(converted.reading, TRIAL_POINTS)
    misfit = evidence.of(converted.reading).misfit_near
    if math.isinf(misfit):
        raise FieldFormatError("the field or its gradient evaluates to NaN or infinity", reason="FIELD_NOT_FINITE")
    said = json.dumps(assumed.say)
    if misfit < _CONFIRMED and all(misfit <= evidence.of(make()).misfit_near for make in assumed.beside):
        why = f"{said}, as is usual: the gradient's norm at the surface is {misfit:.2f} from 1"
        return replace(converted, why=(*converted.why, why), assumed=None)
    usual = Variant(said, assumed.say, lambda reading: reading)
    raise untold_error(
        converted, (usual, *assumed.others), "with the usual number the field does not behave like a distance"
    )


_CONFIRMED = 0.25
"""How far the gradient's norm at the surface may be from 1 for an assumed number to be right."""


def _choose(readings: Sequence[Reading], share: int) -> tuple[Reading, list[str]]:
    evidence = Evidence(readings[0], TRIAL_POINTS)
    trials = [evidence.of(reading) for reading in readings[:MAX_TRIED]]
    for best in {id(trial): trial for trial in (min(trials, key=lambda trial: trial.mean), _best(trials))}.values():
        # the same grid over another cube, or beside other sines
        trials += [evidence.of(reading) for reading in readings[MAX_TRIED:] if reading.is_grid_of(best.reading)]
    nearest = min(trials, key=lambda trial: trial.mean)
    if math.isinf(nearest.mean):  # none has finite values: the evaluation says so
        return nearest.reading, []
    finest = Evidence(nearest.reading, FINAL_POINTS // share)
    chosen, fitting = chosen_by_misfit(trials, finest)
    if chosen is None or _is_doubtful(chosen, trials, finest):
        best = _best(trials)
        likely = [best] if best.is_telling and not any(trial.reading is best.reading for trial in fitting) else []
        raise _ambiguous([trial.reading for trial in (*likely, *fitting)])
    if others := _over_other_cubes(chosen, readings, finest):
        raise _ambiguous([trial.reading for trial in (chosen, *others)])
    why = [_said(trials, evidence.of(chosen.reading))] if len(trials) > 1 else []
    if chosen.reading.interpolation == "open" and chosen.distance is not None:
        return _interpolated(chosen.reading, share, why)
    return chosen.reading, why


# By how far the gradient's norm is from 1 on average, and by usual numbers.
#
# Readings that fit clearly worse than the best are out. Those left that are one function need no choice. Of the
# others the most usual one is taken if it alone is so usual and the rest lie so near it that it is no accident.


def chosen_by_misfit(trials: Sequence[Trial], finest: Evidence) -> tuple[Trial | None, list[Trial]]:
    """The reading that the misfit and its numbers tell, or None where they do not; and all that fit as well.

    finest: more points, near the surface of the reading that fits best.
    """
    best = min(trials, key=lambda trial: trial.mean)
    left = [trial for trial in trials if not best.is_distance or not best.is_better(trial, _CLEARLY, _LEAST)]
    if best.is_distance and len(left) > 1 and not all(trial.is_same(best) for trial in left):
        # The least usual ones are not asked again.
        finalists = sorted(left, key=lambda trial: (trial.reading.tier, trial.mean))[:FINALISTS]
        again = [finest.of(trial.reading) for trial in finalists]
        best = min(again, key=lambda trial: trial.mean)
        left = [trial for trial in again if not best.is_better(trial, _FINALLY)]
    usual = min(left, key=lambda trial: (trial.reading.tier, trial.mean))
    others = [trial for trial in left if not trial.is_same(usual)]
    return (usual if _is_no_accident(usual, others) else None), [usual, *others]


def _is_no_accident(usual: Trial, others: Sequence[Trial]) -> bool:
    """Whether ``usual`` is the only one, or of numbers so usual that its place among the others is no chance."""
    if not others:
        return True
    scales = [trial.reading.scale for trial in (usual, *others)]
    told = [scale for scale in scales if scale is not None]
    if usual.reading.tier > 0 or any(trial.reading.tier == 0 for trial in others) or len(told) < len(scales):
        return False
    return max(told) - min(told) <= _ACCIDENT


# By what the levels of a grid do, which contradicts the misfit: a misread grid of low resolution is smoother than the
# right one.


def _is_doubtful(chosen: Trial, trials: Sequence[Trial], finest: Evidence) -> bool:
    """Whether the levels do better subtracted than added, or those of another function are more supported."""
    first = next(trial for trial in trials if trial.reading is chosen.reading)
    if chosen.levels is None or all(trial.is_same(first) for trial in trials):
        return False
    mine, best = finest.of(chosen.reading), _best(trials)
    if mine.support < -LEAST_SUPPORT or not best.is_telling:
        return mine.support < -LEAST_SUPPORT
    other = finest.of(best.reading)
    return not other.is_same(mine) and (mine.support < LEAST_SUPPORT or other.support_over(mine) > 0.0)


def _over_other_cubes(chosen: Trial, readings: Sequence[Reading], finest: Evidence) -> list[Trial]:
    """The same grid over other cubes, as far as its levels tell nearly as much there. Points are in other cells there,
    so that the levels cannot be compared one by one."""
    mine = finest.of(chosen.reading)
    cube = chosen.reading.description.get("grid_radius")
    others = [one for one in readings if one.is_grid_of(chosen.reading) and one.description.get("grid_radius") != cube]
    trials = [trial for trial in map(finest.of, others) if trial.is_telling and not trial.is_same(mine)]
    return [trial for trial in trials if mine.support - trial.support < _CLEAR_SUPPORT]


def _best(trials: Sequence[Trial]) -> Trial:
    """The best supported one; where no levels tell, the one nearest to a distance."""
    best = max(trials, key=lambda trial: (trial.is_telling, trial.support))
    return best if best.is_telling else min(trials, key=lambda trial: trial.mean)


# Linear or smoothstep: how a hash grid was interpolated in training, told from the gradient within its cells.
#
# Smoothstep modulates a level's slope within each cell; training makes the other levels cancel that. So under the
# interpolation of training the rest of the gradient's norm does not follow the difference between the two
# interpolations, and under the other one it makes up for all of it. A field that was trained too shortly does not tell.

_TRAINED = 0.08
"""Only a field whose gradient is this near to 1 tells that it was interpolated linearly: one that was trained for
shorter under smoothstep looks like that, too."""
_SMOOTH, _LINEAR = 0.15, -0.3
"""How much more the norm follows the difference under linear than under smoothstep, at least or at most."""
_NEAR = 1.0


def told_interpolation(linear: Trial, smoothstep: Trial) -> Interpolation | None:
    """How the grid was interpolated, by one reading's trials under both; None where they do not tell, or where the
    levels speak against it."""
    if linear.gradient is None or smoothstep.gradient is None:
        return None
    more = _share_undone(smoothstep.gradient, linear.gradient) - _share_undone(linear.gradient, smoothstep.gradient)
    if more > _SMOOTH and smoothstep.support_over(linear) > -LEAST_SUPPORT:
        return "smoothstep"
    if more < _LINEAR and linear.mean < _TRAINED and linear.support_over(smoothstep) > -LEAST_SUPPORT:
        return "linear"
    return None


def _share_undone(gradient: Tensor, other: Tensor) -> float:
    """Slope of the norm of ``gradient`` over what the ``other`` one would add to it: 0 under the right one."""
    norm = gradient.norm(dim=-1).clamp_min(1e-6)
    added = ((other - gradient) * gradient).sum(dim=-1) / norm
    kept = ((norm - 1.0).abs() < _NEAR) & (added.abs() < _NEAR)
    added, beyond = added[kept] - added[kept].mean(), norm[kept] - norm[kept].mean()
    return float((added * beyond).sum() / added.square().sum().clamp_min(1e-12))


def _interpolated(reading: Reading, share: int, why: list[str]) -> tuple[Reading, list[str]]:
    """``reading`` with the interpolation that the evidence tells, or a refusal."""
    for points in (FINAL_POINTS, LAST_POINTS):
        evidence = Evidence(reading, points // share)
        linear, smooth = (evidence.of(_with_interpolation(reading, kind)) for kind in _KINDS)
        if linear.is_same(smooth):
            return reading, why
        told = told_interpolation(linear, smooth)
        if told is not None:
            more = f"{told} interpolation: with it the gradient's norm does not depend on the cells"
            return _with_interpolation(reading, told), [*why, more]
    habit = reading.description["hash"]["interpolation"]
    asked = [_with_interpolation(reading, kind) for kind in sorted(_KINDS, key=lambda kind: kind != habit)]
    # evidence that cannot tell the interpolation is no proof of the layout: whoever answers says both
    raise _ambiguous(asked, whole=True)


def _with_interpolation(reading: Reading, kind: Interpolation) -> Reading:
    grid = {**reading.description["hash"], "interpolation": kind}
    say = {**reading.say, "hash": {**reading.say.get("hash", {}), "interpolation": kind}}
    description = {**reading.description, "hash": grid}
    return replace(reading, name=f"{reading.name}, {kind}", say=say, description=description)


# What is said: the line of the report, or the refusal with what to add.


def _ambiguous(readings: Sequence[Reading], whole: bool = False) -> AmbiguousError:
    """The refusal: what the description may say, the most usual first. whole: with what all have in common, too."""
    say = [reading.say for reading in readings]
    asked = [
        OpenCandidate(one.name, one.say if whole else _shortest(one.say, say), partial(replace, one))
        for one in readings
    ]
    lines = list(dict.fromkeys(json.dumps(one.say) for one in asked))
    more = f", or {len(lines) - MOST_CANDIDATES} others" if len(lines) > MOST_CANDIDATES else ""
    shown = " or ".join(lines[:MOST_CANDIDATES])
    return AmbiguousError(
        f"{len(lines)} readings fit this table equally well; add one of these to the import options: {shown}{more}",
        asked,
    )


def _shortest(entry: dict[str, Any], say: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """``entry`` without the parts of ``hash`` that all have in common."""
    if not all("hash" in other for other in say):
        return entry
    parts = {name: value for name, value in entry["hash"].items() if any(o["hash"].get(name) != value for o in say)}
    return {**entry, "hash": parts or entry["hash"]}


def _said(trials: Sequence[Trial], chosen: Trial) -> str:
    rest = [trial for trial in trials if not trial.is_same(chosen)]
    start = f"hash grid of {chosen.reading.name}: {len(trials)} layouts give a table of this size"
    if not rest:
        return f"{start}, and all give the same function"
    second = min(rest, key=lambda trial: trial.mean)
    by = (f"{trial.mean:.2f}" if math.isfinite(trial.mean) else "any amount" for trial in (chosen, second))
    return f"{start}; with this one the gradient's norm is {next(by)} from 1; under {second.reading.name}, {next(by)}"

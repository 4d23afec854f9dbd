"""Which of several functions a checkpoint's tensors stand for, by evidence from the weights; else it is asked.

Readings that fit clearly worse than the best are out. Those left that are one function need no choice. Of the others
the most usual one is taken if it alone is so usual and the rest lie so near it that it is no accident. What stays open
is refused, with the line to add to the description for each.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from regnf_core.field_candidates import MOST_CANDIDATES
from regnf_core.importing.cost.calls import FINAL_POINTS, FINALISTS, TRIAL_POINTS
from regnf_core.importing.families.converted import ConvertedField, Reading
from regnf_core.importing.gate.ambiguity import AmbiguousError, OpenCandidate
from regnf_core.importing.gate.evidence import Evidence, Trial
from regnf_core.importing.gate.interpolation import told_interpolation
from regnf_core.importing.gate.plausibility import without_new_code
from regnf_core.schema.hash_grid_config import Interpolation

_SHOWN = MOST_CANDIDATES
_CLEARLY, _LEAST = 0.1, 0.01
"""In the first round a reading is out that fits worse by this share of the best's misfit, and by this much at least."""
_TELLING = 0.4
"""A best reading that is itself farther from a distance speaks against no other: the least noisy may be wrong."""
_FINALLY = 0.04
"""The same in the second round, at more points."""
_ACCIDENT = 0.5 * math.log(2.0)
"""Usual numbers are powers of two: among layouts spread by less than this (log of the finest resolution), one of them
is no accident."""


def choose_reading(converted: ConvertedField) -> ConvertedField:
    """``converted`` with the reading that its weights speak for, and with what was decided, and by what, in ``why``.

    Raises AmbiguousError: readings that differ fit alike.
    """
    if not converted.readings:
        return converted
    with without_new_code():
        chosen, why = _choose(converted.readings)
    return replace(
        converted,
        why=(*converted.why, *why),
        description=chosen.description,
        tensors=chosen.tensors,
        readings=(),
    )


def _choose(readings: Sequence[Reading]) -> tuple[Reading, list[str]]:
    evidence = Evidence(readings[0], TRIAL_POINTS)
    trials = [evidence.of(reading) for reading in readings]
    best = min(trials, key=lambda trial: trial.mean)
    speaks = best.mean < _TELLING
    left = [trial for trial in trials if not speaks or not best.is_better(trial, _CLEARLY, _LEAST)]
    finest = Evidence(best.reading, FINAL_POINTS)
    if speaks and len(left) > 1 and not all(trial.is_same(best) for trial in left):
        left = _second_round(left, finest)
    chosen = _settled(left)
    why = [_said(trials, evidence.of(chosen.reading))] if len(trials) > 1 else []
    if chosen.reading.interpolation == "open" and chosen.distance is not None:
        return _interpolated(chosen.reading, finest, why)
    return chosen.reading, why


def _second_round(trials: Sequence[Trial], finest: Evidence) -> list[Trial]:
    """Those of ``trials`` that are as good as the best of them at more points. The least usual ones are not asked."""
    finalists = sorted(trials, key=lambda trial: (trial.reading.tier, trial.mean))[:FINALISTS]
    again = [finest.of(trial.reading) for trial in finalists]
    best = min(again, key=lambda trial: trial.mean)
    return [trial for trial in again if not best.is_better(trial, _FINALLY)]


def _settled(left: Sequence[Trial]) -> Trial:
    """The one of the trials left that stands, or a refusal."""
    usual = min(left, key=lambda trial: (trial.reading.tier, trial.mean))
    others = [trial for trial in left if not trial.is_same(usual)]
    if not others:
        return usual
    rivals = [trial for trial in others if trial.reading.tier <= usual.reading.tier]
    scales = [trial.reading.scale for trial in left if trial.reading.scale is not None]
    if rivals or usual.reading.tier > 0 or len(scales) < len(left) or max(scales) - min(scales) > _ACCIDENT:
        raise _ambiguous([trial.reading for trial in (usual, *others)])
    return usual


def _interpolated(reading: Reading, evidence: Evidence, why: list[str]) -> tuple[Reading, list[str]]:
    """``reading`` with the interpolation that the evidence tells, or a refusal."""
    kinds: tuple[Interpolation, Interpolation] = ("linear", "smoothstep")
    linear, smooth = (evidence.of(_with_interpolation(reading, kind)) for kind in kinds)
    if linear.is_same(smooth):
        return reading, why
    told = told_interpolation(linear, smooth)
    if told is None:
        habit = reading.description["hash"]["interpolation"]
        asked = [_with_interpolation(reading, kind) for kind in sorted(kinds, key=lambda kind: kind != habit)]
        # evidence that cannot tell the interpolation is no proof of the layout: whoever answers says both
        raise _ambiguous(asked, whole=True)
    more = f"{told} interpolation: under it the gradient's norm does not follow the cells"
    return _with_interpolation(reading, told), [*why, more]


def _with_interpolation(reading: Reading, kind: Interpolation) -> Reading:
    grid = {**reading.description["hash"], "interpolation": kind}
    name = f"{reading.name}, {kind}"
    say = {**reading.say, "hash": {**reading.say.get("hash", {}), "interpolation": kind}}
    return replace(reading, name=name, say=say, description={**reading.description, "hash": grid})


def _ambiguous(readings: Sequence[Reading], whole: bool = False) -> AmbiguousError:
    """The refusal: what the description may say, the most usual first. whole: with what all have in common, too."""
    say = [reading.say for reading in readings]
    asked = [
        OpenCandidate(one.name, one.say if whole else _shortest(one.say, say), partial(_same, one)) for one in readings
    ]
    lines = list(dict.fromkeys(json.dumps(one.say) for one in asked))
    more = f", or {len(lines) - _SHOWN} others" if len(lines) > _SHOWN else ""
    message = f"{len(lines)} readings fit this table alike; add one to the description: {' or '.join(lines[:_SHOWN])}"
    return AmbiguousError(message + more, asked)


def _same(reading: Reading) -> Reading:
    return reading


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
        return f"{start}, and all are the same function"
    second = min(rest, key=lambda trial: trial.mean)
    return (
        f"{start}, under this one the gradient's norm is {_by(chosen)} from 1; under {second.reading.name},"
        f" {_by(second)}"
    )


def _by(trial: Trial) -> str:
    return f"{trial.mean:.2f}" if math.isfinite(trial.mean) else "any amount"

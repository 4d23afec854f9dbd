"""Which of several functions a checkpoint's tensors stand for: the one that behaves most like a signed distance.

A hash grid read by another layout than it was trained with is noise: its gradient at the surface is anything but 1.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import build_field
from regnf_core.importing.cost.calls import TRIAL_SAMPLES
from regnf_core.importing.families.converted import ConvertedField, Reading
from regnf_core.importing.gate.plausibility import check_plausibility
from regnf_core.schema.parsing import parse_description

_CLEARLY_BETTER = 0.05
"""A reading must beat the most usual one by this much in its gradient's norm to be preferred."""


@dataclass(frozen=True)
class _Trial:
    reading: Reading
    misfit: float
    """How far the gradient's norm at the surface is from 1: mean over its 10th, 50th and 90th percentile."""


def choose_reading(converted: ConvertedField) -> ConvertedField:
    """``converted`` with the reading that fits best, and with what was chosen in ``why`` and ``warnings``.

    The most usual reading stays unless another is clearly better. A choice that others come close to is warned of:
    HASH_GRID_AMBIGUOUS.
    """
    if not converted.readings:
        return converted
    trials = [_Trial(reading, _misfit(reading)) for reading in converted.readings]
    best = min(trials, key=lambda trial: trial.misfit)
    chosen = best if best.misfit < trials[0].misfit - _CLEARLY_BETTER else trials[0]
    rest = [trial for trial in trials if trial is not chosen]
    runner_up = min(rest, key=lambda trial: trial.misfit)
    why = (
        f"hash grid of {chosen.reading.name}: {len(trials)} layouts give a table of this size, under this one the"
        f" gradient's norm at the surface is {_by(chosen)} from 1; under {runner_up.reading.name}, {_by(runner_up)}"
    )
    said = converted.warnings
    if runner_up.misfit < chosen.misfit + _CLEARLY_BETTER:
        text = f"{runner_up.reading.name} fits as well as {chosen.reading.name}; say which under 'hash'"
        said = (*said, f"HASH_GRID_AMBIGUOUS: {text}")
    return replace(
        converted,
        why=(*converted.why, why),
        description=chosen.reading.description,
        tensors=chosen.reading.tensors,
        warnings=said,
        readings=(),
    )


def _misfit(reading: Reading) -> float:
    try:
        description = parse_description(reading.description)
        with warnings.catch_warnings():
            # the map of the upload is only read
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")
            tensors = {name: torch.from_numpy(array) for name, array in reading.tensors.items()}
        measured, _ = check_plausibility(build_field(description, tensors), TRIAL_SAMPLES)
    except FieldFormatError:  # a layout beyond what a field may have, no surface, or numbers that are not finite
        return math.inf
    norms = [measured[f"gradient_{quantile}"] for quantile in ("p10", "median", "p90")]
    return sum(abs(norm - 1.0) for norm in norms) / len(norms)


def _by(trial: _Trial) -> str:
    return f"{trial.misfit:.2f}" if math.isfinite(trial.misfit) else "any amount"

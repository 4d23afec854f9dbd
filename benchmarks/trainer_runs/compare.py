"""What regnf makes of the written runs, with their settings and without."""

from __future__ import annotations

import json
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.trainer_runs.write import FACTS, REFERENCE
from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.fields.observation import has_color
from regnf_core.importing.gate.convert import convert_file
from regnf_core.importing.gate.gate import FIELD_NAME, import_field
from regnf_core.importing.gate.reading import Companions
from regnf_core.importing.gate.report import ImportLimits
from regnf_core.importing.run.folder import find_run, pack_settings

RIGHT, WRONG = 1e-5, 1e-3
GRADIENT = 1e-3


@dataclass(frozen=True)
class Outcome:
    """How one import ended."""

    trainer: str
    number: str
    kind: str
    """exact, right (within 1e-3 of the range), wrong (and told of by nothing), or refused."""
    error: float
    gradient_error: float
    reason: str
    detail: str
    seconds: float
    color_error: float = float("nan")
    """Largest, of any channel; not a number where no color was written, infinite where it was not read."""


def compare_run(place: Path, with_settings: bool, in_this_process: bool = False) -> Outcome:
    """Import the run in ``place`` and compare it at its reference points.

    in_this_process: without the gate's own process, which loads its libraries anew for each file.
    """
    facts = json.loads((place / FACTS).read_text())
    names = (place.parent.name, place.name)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            convert = _convert if in_this_process else _import
            why = convert(place, facts, Path(folder), with_settings)
        except FieldFormatError as error:
            spent = time.perf_counter() - started
            return Outcome(*names, "refused", float("nan"), float("nan"), error.reason, str(error), spent)
        spent = time.perf_counter() - started
        reference = np.load(place / REFERENCE)
        error, gradient_error = _errors(Path(folder) / FIELD_NAME, reference)
        colored = color_error(Path(folder) / FIELD_NAME, reference)
    exact = error <= RIGHT and gradient_error <= GRADIENT
    kind = "exact" if exact else "right" if error <= WRONG else "wrong"
    return Outcome(*names, kind, error, gradient_error, "", why, spent, colored)


def _import(place: Path, facts: dict[str, Any], folder: Path, with_settings: bool) -> str:
    """By the gate, as a user's upload. Returns what it says of it."""
    if not with_settings:
        report = import_field(place / facts["checkpoint"], folder, facts["description"])
    else:
        run = find_run(place / "run")
        report = import_field(run.checkpoint, folder, facts["description"], settings=pack_settings(run, folder))
    return "; ".join(report.why + report.warnings)


def _convert(place: Path, facts: dict[str, Any], folder: Path, with_settings: bool) -> str:
    """What the gate's process does, here and unconfined."""
    if not with_settings:
        values = convert_file(place / facts["checkpoint"], folder, facts["description"], ImportLimits())
    else:
        run = find_run(place / "run")
        packed = pack_settings(run, folder)
        beside = Companions(settings=(packed.name, packed))
        values = convert_file(run.checkpoint, folder, facts["description"], ImportLimits(), beside=beside)
    return "; ".join([*values["why"], *values["warnings"]])


def color_error(field: Path, reference: Any) -> float:
    """Largest error of the color of any channel; see :class:`Outcome`."""
    if "color" not in reference:
        return math.nan
    opened = open_field(field)
    if not has_color(opened):
        return math.inf
    found = opened.color(torch.tensor(reference["points"]).float(), torch.tensor(reference["directions"]).float())
    return float(np.abs(found.double().numpy() - reference["color"])[reference["steady"]].max())


def _errors(field: Path, reference: Any) -> tuple[float, float]:
    """Largest error of the distance over its range, and the 99th percentile of the gradient's."""
    points = torch.tensor(reference["points"]).float()
    distance, gradient = open_field(field).signed_distance_and_gradient(points)
    spread = float(np.ptp(reference["distance"]))
    error = np.abs(distance.double().numpy() - reference["distance"]).max() / spread
    apart = np.linalg.norm(gradient.double().numpy() - reference["gradient"], axis=1)
    return float(error), float(np.quantile(apart, 0.99))

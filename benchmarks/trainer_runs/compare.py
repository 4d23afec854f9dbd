"""What regnf makes of the written runs, with their settings and without."""

from __future__ import annotations

import json
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
from regnf_core.importing.gate.gate import FIELD_NAME, import_field
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


def compare_run(place: Path, with_settings: bool) -> Outcome:
    """Import the run in ``place`` and compare it at its reference points."""
    facts = json.loads((place / FACTS).read_text())
    names = (place.parent.name, place.name)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        try:
            report = _import(place, facts, Path(folder), with_settings)
        except FieldFormatError as error:
            spent = time.perf_counter() - started
            return Outcome(*names, "refused", float("nan"), float("nan"), error.reason, str(error), spent)
        spent = time.perf_counter() - started
        error, gradient_error = _errors(Path(folder) / FIELD_NAME, np.load(place / REFERENCE))
    exact = error <= RIGHT and gradient_error <= GRADIENT
    kind = "exact" if exact else "right" if error <= WRONG else "wrong"
    return Outcome(*names, kind, error, gradient_error, "", "; ".join(report.why + report.warnings), spent)


def _import(place: Path, facts: dict[str, Any], folder: Path, with_settings: bool) -> Any:
    if not with_settings:
        return import_field(place / facts["checkpoint"], folder, facts["description"])
    run = find_run(place / "run")
    return import_field(run.checkpoint, folder, facts["description"], settings=pack_settings(run, folder))


def _errors(field: Path, reference: Any) -> tuple[float, float]:
    """Largest error of the distance over its range, and the 99th percentile of the gradient's."""
    points = torch.tensor(reference["points"]).float()
    distance, gradient = open_field(field).signed_distance_and_gradient(points)
    spread = float(np.ptp(reference["distance"]))
    error = np.abs(distance.double().numpy() - reference["distance"]).max() / spread
    apart = np.linalg.norm(gradient.double().numpy() - reference["gradient"], axis=1)
    return float(error), float(np.quantile(apart, 0.99))

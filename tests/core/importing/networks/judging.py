"""What the gate makes of a case, against the case's own function."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits
from tests.core.importing.networks.cases import Case

POINTS, SLOPES, STEP = 60, 15, 1e-6
WRONG = 1e-3
"""Of the range of the values: beyond it a field is another one."""


@dataclass(frozen=True)
class Judged:
    """refused: the reason, or None · value: greatest error, of the range · gradient: greatest error of a component, of
    the longest gradient or of 1 if that is more."""

    refused: str | None
    value: float = 0.0
    gradient: float = 0.0
    detail: str = ""


def judged(case: Case, said: dict[str, Any], folder: Path) -> Judged:
    """The file through the gate's conversion with this description."""
    torch.save(case.checkpoint, folder / "upload")
    try:
        report = convert_file(folder / "upload", folder, said | {"accept_implausible": True}, ImportLimits())
    except FieldFormatError as error:
        return Judged(error.reason, detail=str(error))
    points = np.random.default_rng(9).uniform(-1.0, 1.0, (POINTS, 3)).astype(np.float32)
    distance, gradient = open_field(folder / FIELD_NAME).signed_distance_and_gradient(torch.from_numpy(points))
    exact = points.astype(np.float64)
    expected = np.array([case.function(x) for x in exact])
    value = float(np.abs(distance.numpy() - expected).max() / np.ptp(expected))
    steps = STEP * np.eye(3)
    slopes = np.array(
        [[(case.function(x + h) - case.function(x - h)) / (2.0 * STEP) for h in steps] for x in exact[:SLOPES]]
    )
    turned = np.abs(gradient.numpy()[:SLOPES] - slopes).max() / max(1.0, float(np.abs(slopes).max()))
    return Judged(None, value, float(turned), "; ".join(report["why"]))

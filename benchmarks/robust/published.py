"""The paper's figures (Reg-NF, table I) and its metrics, so that a table can put ours beside them."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from benchmarks.robust.cases import Case
from benchmarks.robust.runs import Run
from benchmarks.symmetric_errors import Symmetries, surface_displacement
from regnf_core import RegistrationResult, Sim3
from regnf_core.geometry import metrics

_POINTS = 500
"""Surface points, about, by which the nearest of the equal poses is chosen."""


class Errors(NamedTuple):
    """Translation RMSE (object units), RMSE of the Euler angles (radians), |scale - true scale|."""

    translation: float
    rotation: float
    scale: float


PUBLISHED = {
    ("ac-room", "c"): Errors(0.040, 0.048, 0.019),
    ("ac-room", "dc"): Errors(0.035, 0.039, 0.007),
    ("ac-room", "fc"): Errors(0.018, 0.031, 0.007),
    ("ac-room", "fc-nop"): Errors(0.014, 0.020, 0.060),
    ("ac-room", "mc"): Errors(0.007, 0.009, 0.003),
    ("atbl-room", "et"): Errors(0.398, 2.6, 0.019),
    ("atbl-room", "t"): Errors(0.044, 0.053, 0.004),
    ("atbl-room", "wt"): Errors(0.022, 0.025, 0.006),
    ("mix-room", "dc"): Errors(0.292, 0.641, 0.021),
    ("mix-room", "fc"): Errors(0.029, 0.030, 0.009),
    ("mix-room", "t"): Errors(0.009, 0.012, 0.005),
}
"""By room and object, means of ten runs, scenes seen from all round."""
UNSOLVED = (("atbl-room", "et"), ("mix-room", "dc"))
"""The pairs that the published method does not solve."""
MEAN_OF_SOLVED = Errors(0.024, 0.030, 0.013)
SINGLE_VIEW_TRANSLATION = {"c": 0.307, "dc": 0.674, "fc": 0.378, "fc-nop": 0.681, "mc": 0.147}
"""The same error, scenes seen in one bad view."""


def paper_errors(case: Case, result: RegistrationResult) -> dict[str, Any]:
    """The paper's metrics of the pose returned that is nearest to the truth, or to one of its equals by symmetry."""
    if case.truth is None:
        return {}
    points = result.object_samples.points
    points = points[:: max(1, len(points) // _POINTS)]
    poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
    found = [nearest_equal(pose, case.truth, points, case.symmetries) for pose in poses]
    number = min(range(len(poses)), key=lambda i: found[i][0])
    return errors_between(poses[number], found[number][1])._asdict()


def nearest_equal(estimate: Sim3, truth: Sim3, points: torch.Tensor, symmetries: Symmetries) -> tuple[float, Sim3]:
    """Of the truth and its equals by symmetry the one with the least MSSD, and that MSSD, object units."""
    largest = surface_displacement(estimate, truth, points, symmetries).amax(-1)
    best, S = int(largest.argmin()), symmetries.transforms()
    return float(largest[best]), Sim3(S.scale[best], S.rotation[best], S.translation[best]).inverse() @ truth


def errors_between(estimate: Sim3, truth: Sim3) -> Errors:
    """The paper's three numbers."""
    return Errors(*metrics.paper_errors(estimate, truth).values())


def mean_errors(runs: Sequence[Run]) -> Errors | None:
    """Means over the runs that gave a pose, whatever their verdict, as the published method has none; None: no run."""
    posed = [run for run in runs if "translation" in run]
    if not posed:
        return None
    return Errors(*(statistics.fmean(run[name] for run in posed) for name in Errors._fields))


def better(ours: Errors | None, theirs: Errors) -> bool:
    """Whether all three are smaller."""
    return ours is not None and all(a < b for a, b in zip(ours, theirs, strict=True))


def in_words(errors: Errors | None) -> str:
    """Translation / rotation / scale."""
    return "" if errors is None else " / ".join(f"{value:.4f}" for value in errors)

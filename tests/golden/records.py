"""What is kept of a golden registration, and when two of them count as the same result.

Two processors round differently: their vector instructions add in another order. This was measured with AVX2, without
vector instructions, and with one and two threads. Poses differ by at most 4e-8 object diameters on exact fields, and by
at most 8e-6 on neural fields; the limits below are 25 times and 6 times as large. Verdicts, reasons, iterations and
evaluations are equal. Shares of inliers differ by at most 0.02: a sample on an edge has the normal of either face.
Poses that explain the data equally well come in any order.

The published method is run on exact fields only, where it differs by less than 1e-15. On neural fields its poses differ
by several percent between processors, because RANSAC then chooses another draw.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from regnf_core import RegistrationResult, Sim3
from tests.golden.cases import Case

RECORDED = Path(__file__).with_name("golden.json")
EXACT_FIELDS, NEURAL_FIELDS = 1e-6, 5e-5
"""Largest distance between two poses of a box's corners, object diameters."""
_METRICS: Mapping[str, tuple[float, float]] = {
    "object_diameter": (0.0, 1e-5),
    "residual_rms": (1e-6, 1e-3),
    "inlier_share_scene": (0.04, 0.0),
    "inlier_share_object": (0.04, 0.0),
    "iterations": (0.0, 0.0),
    "field_evaluations": (0.0, 5e-3),
}
"""The metrics that are kept, each with the largest difference: absolute, and relative to the recorded value."""


@dataclass(frozen=True)
class Recorded:
    """The contents of golden.json. sources: digest of the engine's code · results: by the case's name."""

    revision: int
    sources: str
    results: dict[str, dict[str, Any]]

    @classmethod
    def load(cls, path: Path = RECORDED) -> Recorded:
        return cls(**json.loads(path.read_text(encoding="utf-8")))

    def save(self, path: Path = RECORDED) -> None:
        document = {"revision": self.revision, "sources": self.sources, "results": self.results}
        path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def record_of(result: RegistrationResult) -> dict[str, Any]:
    """What golden.json keeps of a result."""
    return {
        "verdict": result.verdict,
        "verdict_reason": result.verdict_reason,
        "T_object_scene": result.T_object_scene.matrix().tolist(),
        "alternatives": [one.T_object_scene.matrix().tolist() for one in result.alternatives],
        "metrics": {name: result.metrics[name] for name in _METRICS},
    }


def differences(case: Case, recorded: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[str]:
    """A sentence for each thing that is not the same."""
    for name in ("verdict", "verdict_reason"):
        if recorded[name] != found[name]:
            yield f"{case.name}: {name} {recorded[name]} -> {found[name]}"
    poses, now = ([one["T_object_scene"], *one["alternatives"]] for one in (recorded, found))
    if len(poses) != len(now):
        yield f"{case.name}: {len(poses)} poses -> {len(now)}"
        return
    limit = NEURAL_FIELDS if case.neural else EXACT_FIELDS
    left = list(now)
    for place, old in enumerate(poses):
        distances = [_corner_distance(case, old, new) / recorded["metrics"]["object_diameter"] for new in left]
        apart = min(distances)
        left.pop(distances.index(apart))
        if not apart <= limit:
            yield f"{case.name}: pose {place} moved by {apart:.3g} object diameters (limit {limit:g})"
    for name, (absolute, relative) in _METRICS.items():
        old, new = recorded["metrics"][name], found["metrics"][name]
        if not abs(new - old) <= absolute + relative * abs(old):
            yield f"{case.name}: {name} {old!r} -> {new!r}"


def _corner_distance(case: Case, old: list[list[float]], new: list[list[float]]) -> float:
    """Largest distance between the places of the detection's corners, object units."""
    corners = case.detection.corners()
    moved = Sim3.from_matrix(new).apply(corners) - Sim3.from_matrix(old).apply(corners)
    return float(torch.linalg.vector_norm(moved, dim=-1).max())

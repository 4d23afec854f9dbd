"""Runs of every trainer, each with points, distances and gradients that its function gives."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, is_dataclass
from pathlib import Path

import numpy as np
import torch

from benchmarks.trainer_runs.run import WrittenRun
from benchmarks.trainer_runs.trainers import TRAINERS

POINTS = 1000
_ROUNDING = 1e-6
"""Of coordinates up to 4 in single precision, several times."""
_CHANGE = 1e-3
REFERENCE = "reference.npz"
FACTS = "facts.json"


def write_runs(folder: Path, trainers: list[str], count: int, seed: int, steps: int) -> None:
    """``count`` runs of each trainer under ``folder``/<trainer>/<number>; those that are there already stay."""
    for name in trainers:
        for number in range(count):
            place = folder / name / f"{number:03d}"
            if (place / FACTS).exists():
                continue
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            source = np.random.default_rng([seed, number, list(TRAINERS).index(name)])
            run = TRAINERS[name](place / "run", source, steps)
            _keep(place, run, source)


def _steady(run: WrittenRun, points: torch.Tensor) -> torch.Tensor:
    """Where the gradient is the same a rounding away: not on the borders of a grid's cells, which show in a color."""
    changes = [
        run.reference(points + _ROUNDING * step)[1] - run.reference(points - _ROUNDING * step)[1]
        for step in torch.eye(3, dtype=torch.float64)
    ]
    return torch.stack(changes).abs().amax(dim=(0, 2)) < _CHANGE


def _keep(place: Path, run: WrittenRun, source: np.random.Generator) -> None:
    points = torch.tensor(source.uniform(-run.reach, run.reach, (POINTS, 3)))
    # What a field is asked is in single precision.
    points = points.float().double()
    distance, gradient = run.reference(points)
    directions = torch.nn.functional.normalize(torch.tensor(source.normal(size=points.shape)), dim=1).float()
    colors = {}
    if run.color is not None:
        colors = {"directions": directions, "color": run.color(points, directions), "steady": _steady(run, points)}
    np.savez(place / REFERENCE, points=points, distance=distance, gradient=gradient, **colors)
    facts = {
        "checkpoint": str(run.checkpoint.relative_to(place)),
        "description": run.description,
        "settings": run.settings,
    }
    (place / FACTS).write_text(json.dumps(facts, default=lambda o: asdict(o) if is_dataclass(o) else str(o)))

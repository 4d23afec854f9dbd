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


def _keep(place: Path, run: WrittenRun, source: np.random.Generator) -> None:
    points = torch.tensor(source.uniform(-run.reach, run.reach, (POINTS, 3)))
    # What a field is asked is in single precision.
    points = points.float().double()
    distance, gradient = run.reference(points)
    np.savez(place / REFERENCE, points=points, distance=distance, gradient=gradient)
    facts = {
        "checkpoint": str(run.checkpoint.relative_to(place)),
        "description": run.description,
        "settings": run.settings,
    }
    (place / FACTS).write_text(json.dumps(facts, default=lambda o: asdict(o) if is_dataclass(o) else str(o)))

"""Which layouts of hash grids the gate reads right, without and with the trainer's settings.

    python -m benchmarks.checkpoint_layouts --count 25 --seed 2 --output benchmarks/results/checkpoint_layouts.md

Random settings of every family with a hash grid, fields trained for a few steps (one in six not at all), checkpoints as
the trainers leave them. A result is wrong if a distance is off by more than 1e-3 of their range. Ends with status 1 if
one was wrong and not refused. Odd seeds were used for the choice of constants, even ones for the report.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import torch

from benchmarks.checkpoint_layouts.settings import FAMILIES, Settings, random_settings
from benchmarks.checkpoint_layouts.training import function_of, train
from benchmarks.checkpoint_layouts.writers import write
from regnf_core.errors import FieldFormatError
from regnf_core.fields.build import open_field
from regnf_core.importing.gate.convert import FIELD_NAME, convert_file
from regnf_core.importing.gate.report import ImportLimits

_BAR = 1e-3
_POINTS = 512
_WITHOUT, _WITH = "without settings", "with settings"


def main() -> int:
    """Train, write, import, compare; write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=25)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    lines = [
        f"# Layouts of hash grids: {options.count} random settings a family, seed {options.seed}\n",
        "| family | settings | right | refused or asked | wrong | processor seconds, mean (most) |",
        "|---|---|---|---|---|---|",
    ]
    wrong = 0
    for family in options.families:
        results: dict[str, list[tuple[str, float]]] = {_WITHOUT: [], _WITH: []}
        for number in range(options.count):
            for kind, result in _results_of(family, options.seed, number).items():
                results[kind].append(result)
        for kind, found in results.items():
            counts = Counter(word for word, _ in found)
            seconds = [spent for _, spent in found]
            timing = f"{sum(seconds) / len(seconds):.1f} ({max(seconds):.1f})"
            row = (counts["right"], counts["refused"], counts["wrong"])
            lines.append(f"| {family} | {kind} | {' | '.join(map(str, row))} | {timing} |")
            wrong += counts["wrong"]
    text = "\n".join(lines) + "\n"
    sys.stdout.write(text)
    if options.output is not None:
        options.output.write_text(text)
    return 1 if wrong else 0


def _results_of(family: str, seed: int, number: int) -> dict[str, tuple[str, float]]:
    rng = random.Random(f"{family} {seed} {number}")
    settings = random_settings(family, rng)
    field = train(settings, rng.randrange(1 << 30))
    points = settings.radius * (2.0 * torch.rand(_POINTS, 3, generator=torch.Generator().manual_seed(5)) - 1.0)
    expected = function_of(settings, field).value_and_gradient(points)[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "upload.ckpt"
        write(path, settings, field)
        cases = {_WITHOUT: None, _WITH: _description(settings)}
        return {kind: _import(path, Path(folder), said, points, expected) for kind, said in cases.items()}


def _description(settings: Settings) -> dict[str, Any]:
    said = dict(settings.written)
    if settings.family == "sdfstudio":
        said["use_grid"] = settings.uses_grid
    if settings.open_levels < settings.grid.levels:
        said["level_mask"] = settings.open_levels
    return said


def _import(
    path: Path, folder: Path, said: dict[str, Any] | None, points: torch.Tensor, expected: torch.Tensor
) -> tuple[str, float]:
    """Whether the file is read right, and the processor seconds that took."""
    started = time.process_time()
    try:
        convert_file(path, folder, said, ImportLimits())
    except FieldFormatError:
        return "refused", time.process_time() - started
    spent = time.process_time() - started
    distance = open_field(folder / FIELD_NAME).signed_distance(points)
    off = float((distance - expected).abs().max() / (expected.max() - expected.min()))
    return ("right" if off < _BAR else "wrong"), spent


if __name__ == "__main__":
    sys.exit(main())

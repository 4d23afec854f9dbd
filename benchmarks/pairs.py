"""Register every pair of the benchmark and say how wrong each registration is.

    python -m benchmarks.pairs FIELDS [--preset robust] [--seeds 10] [--output table.md]

FIELDS is the folder that benchmarks.make_fields wrote. A run succeeds when its MSSD, the least over the poses returned
(an ambiguous result lists several), is at most 5 % of the object's diameter; `registered` and wrong is counted apart.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch loads

import torch

from regnf_core import OrientedBox, RegistrationOptions, Sim3, open_field, register
from regnf_core.metrics import errors_against_truth

SUCCESS = 0.05


def run(folder: Path, pair: dict[str, Any], options: RegistrationOptions, seed: int) -> dict[str, Any]:
    """One registration: verdict, the best pose's errors, evaluations and seconds (fields open already)."""
    scene = open_field(folder / f"{pair['room']}.safetensors")
    obj = open_field(folder / f"{pair['object']}.safetensors")
    box = OrientedBox.from_quaternion(pair["detection"]["centre"], pair["detection"]["size"])
    truth = Sim3.from_dict(pair["truth"]["T_object_scene"])
    begun = time.perf_counter()
    result = register(scene, obj, box, options, seed)
    seconds = time.perf_counter() - begun
    poses = [result.T_object_scene, *(other.T_object_scene for other in result.alternatives)]
    points = result.object_samples.points.double()
    errors = min((errors_against_truth(pose, truth, points) for pose in poses), key=lambda one: one["mssd_share"])
    return {"verdict": result.verdict, "seconds": seconds, "poses": len(poses), **result.metrics, **errors}


def row(name: str, runs: list[dict[str, Any]]) -> str:
    def median(key: str) -> float:
        return statistics.median(one[key] for one in runs)

    evaluations, seconds = median("field_evaluations") / 1000, median("seconds")
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(one["verdict"] for one in runs).items())
    good = sum(one["mssd_share"] <= SUCCESS for one in runs)
    wrong = sum(one["verdict"] == "registered" and one["mssd_share"] > SUCCESS for one in runs)
    return (
        f"| {name} | {good}/{len(runs)} | {wrong} | {verdicts} | {100 * median('mssd_share'):.3f} "
        f"| {100 * max(one['mssd_share'] for one in runs):.3f} | {median('rotation_error_rad'):.4f} "
        f"| {100 * median('scale_error_share'):.3f} | {evaluations:.0f} | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", type=Path)
    parser.add_argument("--preset", default="robust", choices=("paper", "robust"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    options = RegistrationOptions.from_dict({"preset": arguments.preset})
    lines = [
        f"Preset `{arguments.preset}`, {arguments.seeds} seeds. Command: `python -m benchmarks.pairs FIELDS --preset "
        f"{arguments.preset} --seeds {arguments.seeds}`, {datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, "
        f"{torch.get_num_threads()} thread(s), torch {torch.__version__}",
        "",
        "| pair | MSSD <= 5 % | registered and wrong | verdicts | MSSD % median | worst | rotation rad | scale % "
        "| evaluations (1000) | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    everything: list[dict[str, Any]] = []
    for pair in json.loads((arguments.fields / "pairs.json").read_text()):
        runs = [run(arguments.fields, pair, options, seed) for seed in range(arguments.seeds)]
        lines.append(row(f"{pair['room']} {pair['object']}", runs))
        print(lines[-1], flush=True)
        everything += runs
    lines.append(row("**all**", everything))
    text = "\n".join(lines) + "\n"
    print(text)
    if arguments.output:
        arguments.output.write_text(f"# Eleven pairs\n\n{text}")


if __name__ == "__main__":
    main()

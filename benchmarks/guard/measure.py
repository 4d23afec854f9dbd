"""Times the cases in this process, with the regnf_core that PYTHONPATH names, and prints the figures as JSON.

python benchmarks/guard/measure.py TREE FIELDS REPEATS CASE...
"""

from __future__ import annotations

import cProfile
import importlib
import json
import pstats
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

STAGES = {
    "object model": "model_object",
    "scene view": "view_scene",
    "distance tables": "nearest_sample_distance",
    "seeds": "geometric_seeds",
    "search": "search_poses",
    "refinement": "refine_poses",
    "verdict": "evaluate_candidates",
    "covariance": "pose_covariance",
    "clouds": "with_clouds",
}
"""The functions whose time is told, by what they do. The distance tables are part of the model and of the search."""


def processor_seconds(task: Callable[[int], Any], repeats: int) -> list[float]:
    """What each run takes of a processor, in all threads, after one that does not count."""
    task(repeats)
    found = []
    for number in range(repeats):
        begun = time.process_time()
        task(number)
        found.append(time.process_time() - begun)
    return found


def stages(task: Callable[[int], Any], repeats: int) -> dict[str, float]:
    """Seconds of a processor in each stage of a run. The profiler's own work counts with it."""
    profile = cProfile.Profile(time.process_time)
    for number in range(repeats):
        profile.runcall(task, number)
    by_function = {name: cumulative for (_, _, name), (_, _, _, cumulative, _) in pstats.Stats(profile).stats.items()}  # type: ignore[attr-defined]
    return {stage: by_function.get(name, 0.0) / repeats for stage, name in STAGES.items()}


def main() -> None:
    tree, folder, repeats, names = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
    begun = time.process_time()
    import torch

    import regnf_core
    from regnf_core import library  # noqa: F401

    imported = time.process_time() - begun
    if not Path(regnf_core.__file__).is_relative_to(tree):
        raise SystemExit(f"regnf_core comes from {regnf_core.__file__}, not from {tree}")
    torch.set_num_threads(1)
    cases = importlib.import_module("cases").cases  # beside this file: the other commit may not have it

    told = {"import": {"seconds": imported}}
    for case in cases():
        if case.name in names:
            task = case.make(folder)
            told[case.name] = {"seconds": statistics.median(processor_seconds(task, repeats))}
            if not case.name.endswith("evaluator"):
                told[case.name] |= stages(task, max(1, repeats // 2))
    print(json.dumps(told))


if __name__ == "__main__":
    main()

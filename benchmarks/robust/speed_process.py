"""Times registrations in this process, both presets side by side, and prints the runs as JSON: see the table `speed`.

python -m benchmarks.robust.speed_process FIELDS PAIRS.json SEEDS LIMIT
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

from benchmarks.robust.cases import load_pairs
from benchmarks.robust.runs import ROBUST, Job, Run, run_one, summary
from regnf_core import RegistrationOptions

PAPER = RegistrationOptions(preset="paper")


def main() -> None:
    folder, file, seeds, limit = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    pairs = load_pairs(folder, file)[:limit]
    run_one(Job(pairs[0].case, "warm-up"))
    runs: list[Run] = []
    for pair in pairs:
        for seed in range(seeds):
            runs.append(run_one(Job(pair.case, "robust", seed, ROBUST)))
            print(summary(runs[-1]), file=sys.stderr, flush=True)
        runs.append(run_one(Job(pair.case, "paper", 0, PAPER)))
        print(summary(runs[-1]), file=sys.stderr, flush=True)
    print(json.dumps([{**run, "threads": torch.get_num_threads()} for run in runs]))


if __name__ == "__main__":
    main()

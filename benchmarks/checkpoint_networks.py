"""Random configurations of the families of plain networks, with what their settings say and without.

    python -m benchmarks.checkpoint_networks --count 25 --seed S --output benchmarks/results/checkpoint_networks.md
        [--families neus siren ...] [--steps 250] [--jobs 1]

With the settings the networks are random. Without them the same configurations are trained for ``--steps`` steps of
Adam towards the distance of a random solid. Their functions are evaluated slowly in float64, by code of the tests.
Ends with status 1 where a field is silently wrong, or not as its settings say.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch

from tests.core.importing.networks.cases import FAMILIES
from tests.core.importing.networks.judging import WRONG, Judged, judged

VALUE_BAR, GRADIENT_BAR = 1e-5, 1e-3


def run(family: str, seed: int, number: int, steps: int) -> Judged:
    """One configuration. steps 0: at random, with its settings; else trained, and without them."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    case = FAMILIES[family](np.random.default_rng([seed, number]), steps)
    said = case.beside | ({} if steps else case.said)
    with tempfile.TemporaryDirectory(prefix="regnf-networks-") as folder:
        found = judged(case, said, Path(folder))
    line = f"{family} {number} ({case.told}), {steps} steps: {found.refused} {found.value:.1e} {found.gradient:.1e}"
    sys.stderr.write(f"{line} {found.detail[:160]}\n")
    return found


def row(family: str, said: list[Judged], unsaid: list[Judged]) -> str:
    """A line of the table."""
    good = sum(one.refused is None and one.value <= VALUE_BAR and one.gradient <= GRADIENT_BAR for one in said)
    value = max((one.value for one in said), default=0.0)
    gradient = max((one.gradient for one in said), default=0.0)
    right = sum(one.refused is None and one.value <= VALUE_BAR for one in unsaid)
    near = sum(one.refused is None and VALUE_BAR < one.value <= WRONG for one in unsaid)
    wrong = sum(one.refused is None and one.value > WRONG for one in unsaid)
    refused = Counter(one.refused for one in unsaid if one.refused)
    told = ", ".join(f"{count} {reason}" for reason, count in refused.items()) or "none"
    return (
        f"| {family} | {good} of {len(said)} | {value:.1e} | {gradient:.1e} | {right} of {len(unsaid)} | {near} | "
        f"{told} | {wrong} |"
    )


def table(arguments: argparse.Namespace, rows: list[str]) -> str:
    """The command, what is right, and the rows of the families so far."""
    return "\n".join(
        [
            f"Command: `python -m benchmarks.checkpoint_networks --count {arguments.count} --seed {arguments.seed} "
            f"--steps {arguments.steps}`, torch {torch.__version__}",
            "",
            f"With settings: values within {VALUE_BAR:g} of their range, gradients within {GRADIENT_BAR:g}. Without: "
            f"wrong is beyond {WRONG:g} of the range; whoever is refused is told what to say.",
            "",
            "| family | with settings | largest value error | largest gradient error | without: right | off by less "
            "than 1e-3 | refused | silently wrong |",
            "|---|---|---|---|---|---|---|---|",
            *rows,
        ]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=25)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    rows, failed = [], False
    pool = ProcessPoolExecutor(arguments.jobs, multiprocessing.get_context("spawn"))
    # all families at once, so that no process waits for the last of a family
    results = {
        (family, steps): [pool.submit(run, family, arguments.seed, number, steps) for number in range(arguments.count)]
        for family in arguments.families
        for steps in (0, arguments.steps)
    }
    for family in arguments.families:
        said, unsaid = ([one.result() for one in results[family, steps]] for steps in (0, arguments.steps))
        rows.append(row(family, said, unsaid))
        failed |= not rows[-1].endswith("| 0 |") or f"{arguments.count} of {arguments.count}" not in rows[-1][:60]
        if arguments.output:
            arguments.output.write_text(f"# Networks of plain layers\n\n{table(arguments, rows)}\n")
    pool.shutdown()
    sys.stdout.write(table(arguments, rows) + "\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

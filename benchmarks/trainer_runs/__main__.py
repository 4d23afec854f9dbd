"""``python -m benchmarks.trainer_runs write|check``: runs of every trainer with random settings, read by regnf."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import torch

from benchmarks.trainer_runs.trainers import TRAINERS
from benchmarks.trainer_runs.write import FACTS, write_runs

_log = logging.getLogger("benchmarks.trainer_runs")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trainer_runs", description=__doc__)
    parser.add_argument("action", choices=["write", "check"])
    parser.add_argument("--folder", type=Path, required=True, help="where the runs lie")
    parser.add_argument("--count", type=int, default=25, help="runs of each trainer")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=150, help="steps of training")
    parser.add_argument("--trainer", action="append", choices=list(TRAINERS), help="only this one; repeat for more")
    parser.add_argument("--settings", choices=["with", "without", "both"], default="both", help="what is compared")
    parser.add_argument("--in-this-process", action="store_true", help="import without a process for each file")
    parser.add_argument("--output", type=Path, help="the table to write")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)
    trainers = arguments.trainer or list(TRAINERS)
    if arguments.action == "write":
        write_runs(arguments.folder, trainers, arguments.count, arguments.seed, arguments.steps)
    else:
        _check(arguments, trainers)


def _check(arguments: argparse.Namespace, trainers: list[str]) -> None:
    from benchmarks.trainer_runs.compare import compare_run
    from benchmarks.trainer_runs.report import table

    sections = []
    for with_settings in {"with": (True,), "without": (False,), "both": (True, False)}[arguments.settings]:
        outcomes = []
        for name in trainers:
            for facts in sorted((arguments.folder / name).glob(f"*/{FACTS}"))[: arguments.count]:
                outcome = compare_run(facts.parent, with_settings, arguments.in_this_process)
                outcomes.append(outcome)
                _log.info(
                    "%s %s %s %.1e %.1e %s",
                    name,
                    outcome.number,
                    outcome.kind,
                    outcome.error,
                    outcome.gradient_error,
                    f"{outcome.reason} {outcome.detail}"[:300],
                )
        head = "## With the settings file" if with_settings else "## Without"
        sections.append(f"{head}\n\n{table(outcomes)}")
    text = "\n\n".join(sections)
    _log.info("%s", text)
    if arguments.output:
        told = f"--count {arguments.count} --seed {arguments.seed} --settings {arguments.settings}"
        command = f"python -m benchmarks.trainer_runs write|check {told}"
        arguments.output.write_text(
            f"# Runs of every trainer with random settings\n\nCommand: `{command}`.\n\n{text}\n"
        )


if __name__ == "__main__":
    main()

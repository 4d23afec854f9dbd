"""Two commits side by side in one run: what each case takes of a processor before and after, and the ratio.

    python -m benchmarks.guard BASE HEAD [--rounds 3] [--repeats 5] [--only TEXT ...] [--output FILE]

Each commit gets a work tree of its own, which is removed afterwards; HEAD may be "." for the present state. The two
take turns, one process after the other with one thread, so what else the machine does falls on both. Figures are
seconds of processor time (user and system): the median of a process's runs, then the median of the rounds; ratios are
those of each round. A ratio above 1 with its whole range says that HEAD is slower.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from benchmarks.guard.cases import cases
from benchmarks.guard.fields import make_fields
from benchmarks.guard.measure import STAGES

ROOT = Path(__file__).resolve().parents[2]
Figures = dict[str, dict[str, float]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base")
    parser.add_argument("head")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="cases whose name has one of these")
    parser.add_argument("--output", type=Path, help="a Markdown file for the tables")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    names = [case.name for case in cases() if any(text in case.name for text in asked.only)]
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="guard-")))
        trees = [stack.enter_context(tree_of(commit, scratch / side)) for commit, side in _sides(asked)]
        fields = scratch / "fields"
        fields.mkdir()
        make_fields(fields)
        rounds = []
        for number in range(asked.rounds):
            turn = trees if number % 2 == 0 else trees[::-1]
            found = {tree: measured(tree, fields, asked.repeats, names) for tree in turn}
            rounds.append((found[trees[0]], found[trees[1]]))
            print(f"round {number + 1} of {asked.rounds}", file=sys.stderr, flush=True)
    text = report(rounds, _heading(asked))
    print(text)
    if asked.output:
        asked.output.write_text(text + "\n", encoding="utf-8")


def _sides(asked: argparse.Namespace) -> list[tuple[str, str]]:
    return [(asked.base, "base"), (asked.head, "head")]


@contextmanager
def tree_of(commit: str, folder: Path) -> Iterator[Path]:
    """A work tree of the commit; "." is the present one."""
    if commit == ".":
        yield ROOT
        return
    git = ["git", "-C", str(ROOT), "worktree"]
    subprocess.run([*git, "add", "--quiet", "--detach", str(folder), commit], check=True)
    try:
        native = folder / "scripts" / "native_library.py"
        if native.exists():  # an older commit has none
            subprocess.run([sys.executable, str(native)], check=True)
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def measured(tree: Path, fields: Path, repeats: int, names: Sequence[str]) -> Figures:
    """The figures of one process that runs the tree's engine."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": ""}
    script = str(Path(__file__).with_name("measure.py"))
    command = [sys.executable, script, str(tree), str(fields), str(repeats), *names]
    done = subprocess.run(command, cwd=tree, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    found: Figures = json.loads(done.stdout.splitlines()[-1])
    return found


def report(rounds: Sequence[tuple[Figures, Figures]], heading: str) -> str:
    """Both tables as Markdown: the cases, and the stages of each."""
    names = list(rounds[0][0])
    lines = [heading, "", "| case | before s | after s | after / before | range |", "|---|---|---|---|---|"]
    for name in names:
        ratios = [after[name]["seconds"] / before[name]["seconds"] for before, after in rounds]
        before, after = (_median(rounds, side, name, "seconds") for side in (0, 1))
        spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
        lines.append(f"| {name} | {before:.4f} | {after:.4f} | {statistics.median(ratios):.2f} | {spread} |")
    lines += ["", "Stages, before / after, milliseconds under a profiler, which adds to each:", ""]
    lines += ["| case | " + " | ".join(STAGES) + " |", "|---" * (1 + len(STAGES)) + "|"]
    for name in names:
        if len(rounds[0][0][name]) > 1:
            cells = [_stage_cell(rounds, name, stage) for stage in STAGES]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _stage_cell(rounds: Sequence[tuple[Figures, Figures]], name: str, stage: str) -> str:
    before, after = (1000 * _median(rounds, side, name, stage) for side in (0, 1))
    return f"{before:.0f} / {after:.0f}" if before or after else "-"


def _median(rounds: Sequence[tuple[Figures, Figures]], side: int, name: str, what: str) -> float:
    return statistics.median(one[side][name][what] for one in rounds)


def _heading(asked: Any) -> str:
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    commits = [commit if commit == "." else _named(commit) for commit in (asked.base, asked.head)]
    return "\n".join(
        [
            "# Engine: two commits side by side",
            "",
            f"Command: `python -m benchmarks.guard {commits[0]} {commits[1]} --rounds {asked.rounds} --repeats "
            f"{asked.repeats}`, {datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {os.cpu_count()} cores, "
            f"load {load}.",
            "",
            "Seconds of processor time, one thread, medians. The model that is kept is as its file gives it.",
        ]
    )


def _named(commit: str) -> str:
    git = ["git", "-C", str(ROOT), "rev-parse", "--short", commit]
    return subprocess.run(git, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    main()

"""How a table is written: Markdown for people, JSON with every run for programs."""

from __future__ import annotations

import json
import os
import platform
import statistics
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from benchmarks.robust.judging import DEFINITION, NOT_AMONG, SUCCESSES, WRONG
from benchmarks.robust.runs import Run


@dataclass(frozen=True)
class Bar:
    """A bar set beforehand, what was measured, and whether that clears it."""

    asked: str
    measured: str
    met: bool


@dataclass(frozen=True)
class Section:
    """A table of cells under a line of text."""

    text: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Table:
    """A finished benchmark table. failures: which of the runs are listed one by one."""

    name: str
    title: str
    bars: Sequence[Bar]
    sections: Sequence[Section]
    runs: Sequence[Run]
    failures: Sequence[Run]
    success: str = DEFINITION
    notes: Sequence[str] = field(default_factory=list)


def failures_of(runs: Sequence[Run]) -> list[Run]:
    """The runs that are no success."""
    return [run for run in runs if run["category"] not in SUCCESSES]


def successes(runs: Sequence[Run]) -> int:
    """How many of the runs are a success."""
    return len(runs) - len(failures_of(runs))


def of_kind(runs: Sequence[Run], kind: str) -> list[Run]:
    """The runs whose group starts with ``kind``."""
    return [run for run in runs if run["group"].startswith(kind)]


def count(runs: Sequence[Run], category: str) -> int:
    """How many of the runs fall into a category."""
    return sum(run["category"] == category for run in runs)


def by_group(runs: Sequence[Run], key: str = "group") -> dict[str, list[Run]]:
    """The runs by their group, in the order in which the groups first appear."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run[key], []).append(run)
    return groups


def median(runs: Sequence[Run], key: str) -> float:
    """The median of a number over the runs that have it; NaN where none has."""
    values = [run[key] for run in runs if key in run]
    return statistics.median(values) if values else float("nan")


ACCURACY_HEAD = (
    "success",
    "registered wrong",
    "ambiguous, truth not among",
    "verdicts",
    "MSSD % median",
    "worst",
    "rotation rad",
    "scale %",
    "evaluations (1000)",
    "seconds",
)


def accuracy_row(name: str, runs: Sequence[Run]) -> list[str]:
    """A row under ``ACCURACY_HEAD``: medians; the worst MSSD is over the successes."""
    good = [run for run in runs if run["category"] in SUCCESSES]
    worst = max((run["mssd_share"] for run in good), default=float("nan"))
    verdicts = ", ".join(f"{n} {verdict}" for verdict, n in Counter(run["verdict"] for run in runs).items())
    return [
        name,
        f"{len(good)}/{len(runs)}",
        str(count(runs, WRONG)),
        str(count(runs, NOT_AMONG)),
        verdicts,
        f"{100 * median(runs, 'mssd_share'):.3f}",
        f"{100 * worst:.3f}",
        f"{median(runs, 'rotation_error_rad'):.4f}",
        f"{100 * median(runs, 'scale_error_share'):.3f}",
        f"{median(runs, 'field_evaluations') / 1000:.0f}",
        f"{median(runs, 'seconds'):.1f}",
    ]


def accuracy_section(text: str, first: str, runs: Sequence[Run], key: str = "group") -> Section:
    """One row a group, and one for all."""
    rows = [accuracy_row(name, some) for name, some in by_group(runs, key).items()]
    return Section(text, (first, *ACCURACY_HEAD), [*rows, accuracy_row("**all**", runs)])


def share_bar(asked: str, hits: int, total: int, least: float) -> Bar:
    """A bar on a share."""
    if total == 0:
        return Bar(asked, "none run", False)
    return Bar(asked, f"{hits}/{total} ({100 * hits / total:.1f} %)", hits >= least * total)


def write(table: Table, command: str, folder: Path | None, show: Callable[[str], None]) -> None:
    """Show the table, and write ``folder``/NAME.md and NAME.json where there is a folder."""
    text = markdown(table, command)
    show(text)
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{table.name}.md").write_text(text)
    head = {"table": table.name, **_circumstances(command), "success": table.success}
    bars = [vars(bar) for bar in table.bars]
    runs = ",\n".join("  " + json.dumps(_rounded(run)) for run in table.runs)
    (folder / f"{table.name}.json").write_text(
        json.dumps({**head, "bars": bars}, indent=1)[:-2] + f',\n "runs": [\n{runs}\n ]\n}}\n'
    )


def markdown(table: Table, command: str) -> str:
    """The whole table as Markdown."""
    facts = _circumstances(command)
    parts = [
        f"# {table.title}",
        f"Command: `{facts['command']}`, {facts['date']}, {facts['machine']}, torch {facts['torch']}.",
        table.success,
    ]
    if table.bars:
        parts.append(
            _cells(
                ("bar", "measured", "met"), [(b.asked, b.measured, "yes" if b.met else "**no**") for b in table.bars]
            )
        )
    for section in table.sections:
        parts += [section.text, _cells(section.head, section.rows)]
    parts += list(table.notes)
    parts.append(_failures(table.failures))
    return "\n\n".join(part for part in parts if part) + "\n"


def _failures(runs: Sequence[Run]) -> str:
    if not runs:
        return "No failures."
    head = ("group", "case", "seed", "verdict", "reason", "category", "MSSD %")
    rows = []
    for run in runs:
        mssd = f"{100 * run['mssd_share']:.2f}" if "mssd_share" in run else ""
        rows.append([run["group"], run["case"], str(run["seed"]), run["verdict"], run["reason"], run["category"], mssd])
    return f"## Failures\n\nEvery one of the {len(rows)}:\n\n" + _cells(head, rows)


def _cells(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _circumstances(command: str) -> dict[str, str]:
    return {
        "command": command,
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {torch.get_num_threads()} thread(s)",
        "torch": torch.__version__,
    }


def _rounded(run: Run) -> dict[str, Any]:
    return {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in run.items()}

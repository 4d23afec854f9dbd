"""The head of a table: the command, the day, the machine, and how busy it was."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np


def headed(command: str, loads: Sequence[float], lines: Sequence[str]) -> str:
    """``lines`` below the command; ``loads`` are averages over a minute, taken now and then while it ran."""
    return "\n".join(
        [
            f"Command: `{command}`, {datetime.now(UTC):%Y-%m-%d}, {platform.system()} {platform.machine()}, "
            f"{len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}. Load while it ran, its own "
            f"processes included: {min(loads):.1f} to {max(loads):.1f}; before it: {loads[0]:.1f}.",
            "",
            *lines,
        ]
    )


def write(title: str, text: str, output: Path | None) -> None:
    """Show the text, and keep it if asked to."""
    sys.stdout.write(text + "\n")
    if output is not None:
        output.write_text(f"# {title}\n\n{text}\n", encoding="utf-8")


def load() -> float:
    """Processes that run or wait for a core, averaged over a minute."""
    return os.getloadavg()[0]


def quantiles(values: Sequence[float], digits: int = 2) -> str:
    """Median, tenth and ninetieth percentile, as cells of a table."""
    p50, p10, p90 = np.percentile(np.array(values), [50, 10, 90])
    return f"{p50:.{digits}f} | {p10:.{digits}f} | {p90:.{digits}f}"

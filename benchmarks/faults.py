"""Every fault of tests/faults at production's own intervals, and how long the service needs to recover from each.

    python -m benchmarks.faults [arguments of pytest, such as -k sigterm]

Forty minutes. Rewrites the table in benchmarks/results/faults.md; with arguments, or when a test fails, it prints it.
"""

from __future__ import annotations

import ast
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from tests.faults.pace import VARIABLE
from tests.faults.promise import MEASURED, WITHIN_S

_ROOT = Path(__file__).resolve().parents[1]
_TESTS = _ROOT / "tests" / "faults"
_DOCUMENT = _ROOT / "benchmarks" / "results" / "faults.md"
_BEGIN, _END = "<!-- measured: python -m benchmarks.faults -->", "<!-- end -->"
_TEST_TIMEOUT_S = 600


def faults() -> Iterator[tuple[str, str]]:
    """The name of each test and what it says the service does, in the order of the files."""
    for path in sorted(_TESTS.glob("test_*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                yield node.name, (ast.get_docstring(node) or "").partition("\n")[0]


def measured(lines: Path) -> dict[str, list[tuple[float, float]]]:
    """How long each fault lasted and how long the service took afterwards, seconds, by the test's name."""
    found = defaultdict(list)
    for line in lines.read_text().splitlines():
        one = json.loads(line)
        found[one["test"].partition("[")[0]].append((one["lasted"], one["took"]))
    return found


def table(found: dict[str, list[tuple[float, float]]]) -> str:
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, shared"
    rows = [
        f"Measured {datetime.now(UTC):%Y-%m-%d}, {machine}, Python {platform.python_version()}.",
        "",
        "| fault | what happens | lasted, s | over after, s | `-k` |",
        "|---|---|---|---|---|",
    ]
    for name, what in faults():
        if name in found:
            lasted, took = (max(values) for values in zip(*found[name], strict=True))
            shown = f"{lasted:.0f}" if lasted >= 1 else "-"
            title = name.removeprefix("test_").replace("_s_", "'s ").replace("_", " ")
            rows.append(f"| {title} | {what} | {shown} | {took:.1f} | `{name}` |")
    return "\n".join(rows)


def main(arguments: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        lines = Path(folder) / "measured"
        lines.touch()
        environment = os.environ | {VARIABLE: "whole", MEASURED: str(lines)}
        command = [sys.executable, "-m", "pytest", str(_TESTS), "-m", "", f"--timeout={_TEST_TIMEOUT_S}", *arguments]
        status = subprocess.run(command, env=environment, check=False).returncode
        result = table(measured(lines))
    if arguments or status:
        print(result)
        return status
    before, _, rest = _DOCUMENT.read_text().partition(_BEGIN)
    _DOCUMENT.write_text(f"{before}{_BEGIN}\n{result}\n{_END}{rest.partition(_END)[2]}")
    print(f"{_DOCUMENT}: every fault was over within {WITHIN_S:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

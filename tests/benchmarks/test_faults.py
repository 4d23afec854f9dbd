"""The table of faults: every test has a row, and says what happens."""

import json
from pathlib import Path

from benchmarks.faults import faults, measured, table

ROOT = Path(__file__).resolve().parents[2]


def test_every_fault_is_told_and_was_measured() -> None:
    document = (ROOT / "benchmarks" / "results" / "faults.md").read_text(encoding="utf-8")
    told = dict(faults())
    assert len(told) > 25
    for name, what in told.items():
        assert what.endswith("."), name
        assert f"| {what} |" in document, f"{name}: python -m benchmarks.faults"
        assert f"| `{name}` |" in document


def test_a_row_has_the_longest_of_its_measurements(tmp_path: Path) -> None:
    name = "test_kill_of_the_job_s_process"
    lines = [{"test": f"{name}[{case}]", "lasted": 0.2, "took": took} for case, took in ((1, 1.26), (2, 3.21))]
    lines.append({"test": "test_redis_out_of_memory", "lasted": 119.8, "took": 0.5})
    (tmp_path / "measured").write_text("\n".join(map(json.dumps, lines)))
    rows = table(measured(tmp_path / "measured")).splitlines()[4:]
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows] == [
        "kill of the job's process",
        "redis out of memory",
    ]
    assert [row.split(" | ")[2:4] for row in rows] == [["-", "3.2"], ["120", "0.5"]]

"""The examples: what each says of its arguments, and that none answers a mistake with a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def start(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("01_register.py", ["--help"]),
        ("01_register.py", ["absent.ckpt", "absent.ckpt", "absent.json"]),
        ("02_follow_and_look.py", []),
        ("02_follow_and_look.py", ["--help"]),
        ("03_own_field.py", ["--help"]),
        ("04_many_pairs.py", ["absent.jsonl", "results.jsonl"]),
        ("05_pipeline.py", ["http://localhost:1", "absent.jsonl", "results"]),
    ],
)
def test_wrong_arguments_are_answered_with_the_usage(name: str, arguments: list[str]) -> None:
    done = start(name, *arguments)
    assert done.returncode == 1
    assert "usage:" in done.stderr
    assert f"python examples/{name}" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_every_example_is_listed_here() -> None:
    tested = {"01_register.py", "02_follow_and_look.py", "03_own_field.py", "04_many_pairs.py"} | {"05_pipeline.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == tested

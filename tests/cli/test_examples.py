"""The examples: what each says of its arguments, and that none answers a mistake with a traceback."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


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
def test_wrong_arguments_are_answered_with_the_usage(
    name: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    printed = capsys.readouterr()
    said = str(ended.value.code) + printed.err
    assert printed.out == ""
    assert ended.value.code not in (0, None)
    assert "usage:" in said
    assert f"python examples/{name}" in said


def test_every_example_is_listed_here() -> None:
    tested = {"01_register.py", "02_follow_and_look.py", "03_own_field.py", "04_many_pairs.py"} | {"05_pipeline.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == tested

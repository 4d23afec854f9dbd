"""The examples: what each says of its arguments, and that none answers a mistake with a traceback."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
WRONG = [
    ("01_register.py", ["--help"]),
    ("01_register.py", ["absent.ckpt", "absent.ckpt", "absent.json"]),
    ("02_follow_and_look.py", []),
    ("02_follow_and_look.py", ["--help"]),
    ("03_own_field.py", ["--help"]),
    ("04_many_pairs.py", ["absent.jsonl", "results.jsonl"]),
    ("05_pipeline.py", ["http://localhost:1", "absent.jsonl", "results"]),
]


def test_every_example_answers_wrong_arguments_with_its_usage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == {name for name, _ in WRONG}
    for name, arguments in WRONG:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        printed = capsys.readouterr()
        said = str(ended.value.code) + printed.err
        assert (printed.out, ended.value.code in (0, None), "usage:" in said) == ("", False, True)
        assert f"python examples/{name}" in said

"""Runs the command in this process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from regnf_cli.main import main

DATA = Path(__file__).resolve().parents[2] / "examples" / "data"


@dataclass(frozen=True)
class Outcome:
    """How a command ended, and what it said."""

    code: int
    stdout: str
    stderr: str


Run = Callable[..., Outcome]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """``run(*arguments)``: the command `regnf` with these arguments."""
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")  # set by the command otherwise, for all tests that follow

    def call(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["regnf", *(str(argument) for argument in arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capfd.readouterr()
        code = ended.value.code
        return Outcome(code if isinstance(code, int) else 0, captured.out, captured.err)

    return call


@pytest.fixture
def demo() -> list[object]:
    """The arguments of a registration with the demo's fields."""
    fields = [DATA / "mix-room.safetensors", DATA / "armchair.safetensors"]
    return ["register", *fields, "--detection", DATA / "detection.json"]

"""The other commands: what they print, and what they refuse."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import trimesh

from regnf_core import __version__
from tests.cli.conftest import DATA, Run


def test_version_and_help(run: Run) -> None:
    assert run("--version").stdout.strip() == __version__
    assert run("--help").code == 0
    assert run("register", "--help").code == 0


def test_inspect_shows_a_field(run: Run) -> None:
    outcome = run("inspect", DATA / "armchair.safetensors", code=0)
    assert "plausibility:" in outcome.stdout
    assert re.search(r"^parameters +\d{5,}$", outcome.stdout, re.MULTILINE)


@pytest.mark.parametrize("command", ["serve", "worker"])
@pytest.mark.parametrize(("name", "value"), [("REGNF_PORT", "99999"), ("REGNF_API_TOKENS", "my-secret-token")])
def test_faulty_settings_are_named(
    command: str, name: str, value: str, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    outcome = run(command, code=2)
    assert outcome.stderr.startswith("INVALID_SETTINGS ")
    assert name.removeprefix("REGNF_").lower() in outcome.stderr.lower()
    assert value not in outcome.stderr


def test_a_fit_says_which_faces_it_turned(run: Run, tmp_path: Path) -> None:
    leg = trimesh.creation.box(bounds=[[-0.2, -0.2, -1.0], [0.2, 0.2, 0.7]])
    leg.invert()
    top = trimesh.creation.box(bounds=[[-1.0, -1.0, 0.8], [1.0, 1.0, 1.0]])
    trimesh.util.concatenate([top, leg]).export(tmp_path / "table.ply")
    outcome = run(
        "fit", tmp_path / "table.ply", tmp_path / "field.safetensors", "--iterations", "1", "--table-log2", "10", code=0
    )
    assert "table.ply: " in outcome.stderr
    assert "was flipped" in outcome.stderr

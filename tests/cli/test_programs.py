"""The three programs of examples/programs: short, they run, and a user's own type checker takes them."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = sorted((ROOT / "examples" / "programs").glob("*.py"))
SAID = {"one": "registered 1.2", "batch": "0 <registered", "search": "registered 1.2"}


def test_all_three_are_there() -> None:
    assert {path.stem for path in PROGRAMS} == set(SAID)


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.stem)
def test_it_is_short_and_runs(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [line for line in program.read_text(encoding="utf-8").splitlines() if line]
    assert len(lines) <= 8
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(program), run_name="__main__")
    assert SAID[program.stem] in capsys.readouterr().out


@pytest.mark.long
def test_a_users_project_passes_mypy_strict(tmp_path: Path) -> None:
    """In a folder of its own, with the package as it is installed: what editors see."""
    for program in PROGRAMS:
        (tmp_path / program.name).write_text(program.read_text(encoding="utf-8"), encoding="utf-8")
    client = (
        "import regnf\n"
        "\n"
        "with regnf.Client() as client:\n"
        '    result = client.register("room.ckpt", "chair.glb", {"min": [0, 0, 0], "max": [1, 1, 1]})\n'
        "    reveal_type(result.scale)\n"
        "    reveal_type(result.T_object_scene)\n"
    )
    (tmp_path / "client.py").write_text(client, encoding="utf-8")
    wrong = 'import regnf\n\nregnf.register(3, "chair.glb", {})\n'
    (tmp_path / "wrong.py").write_text(wrong, encoding="utf-8")
    names = [*(path.name for path in PROGRAMS), "client.py", "wrong.py"]
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--ignore-missing-imports", *names]
    environment = {"MYPYPATH": str(ROOT), "PATH": "", "HOME": str(tmp_path)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=280
    )
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    assert len(errors) == 1, done.stdout + done.stderr
    assert errors[0].startswith("wrong.py:3")
    assert 'client.py:5: note: Revealed type is "float"' in done.stdout.replace("builtins.", "")

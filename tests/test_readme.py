"""The README keeps its word: its links lead somewhere, its commands exist, its Python runs."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from regnf_cli.main import command
from tests.docs.test_code_blocks import alike, promised

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_local_links_lead_somewhere(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#\s]+)", text)
    missing = [
        target
        for target in targets
        if not target.startswith(("http://", "https://")) and not (document.parent / target).exists()
    ]
    assert not missing


def test_the_readme_is_short_and_its_targets_exist() -> None:
    assert len(README.splitlines()) <= 100
    assert max(map(len, README.splitlines())) <= 200
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = set(re.findall(r"make (\w+)", README))
    assert "demo" in named
    assert named <= set(re.findall(r"^(\w+):", makefile, flags=re.M))


def test_commands_named_in_the_readme_exist(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = "\n".join(re.findall(r"```bash\n(.*?)```", README, flags=re.S))
    named = set(re.findall(r"^(?:\.venv/bin/)?regnf ([\w-]+)", shell, flags=re.M))
    assert {"serve", "register"} <= named
    for name in named:
        monkeypatch.setattr(sys, "argv", ["regnf", name, "--help"])
        assert command() == 0
        assert "Example" in capsys.readouterr().out or name in ("serve", "worker")


def test_python_of_the_readme_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    monkeypatch.chdir(ROOT)
    printed = []
    for code in blocks:
        exec(compile(code, "README.md", "exec"), {})
        printed.append(capsys.readouterr().out)
        assert printed[-1].startswith("registered")
    assert len(blocks) == 1
    for told in promised("\n".join(blocks)):
        assert any(alike(told, line) for line in "\n".join(printed).splitlines()), told

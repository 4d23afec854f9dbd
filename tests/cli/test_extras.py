"""What is said where an extra of the package is not installed."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from regnf_cli.guard import MODULES, require
from regnf_core.errors import MissingExtraError
from tests.cli.conftest import DATA, Run

ROOT = Path(__file__).resolve().parents[2]
FIELD = DATA / "armchair.safetensors"
REGISTER = ["register", FIELD, FIELD, "--detection", DATA / "detection.json"]


def canonical(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


def test_the_table_names_a_module_of_every_requirement() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    distributions = packages_distributions()
    for extra, modules in MODULES.items():
        wanted = {canonical(re.split(r"[^\w.-]", line)[0]) for line in project["optional-dependencies"][extra]}
        wanted -= {"regnf", "pye57"}  # extras of its own, and what some machines have no package of
        known = {canonical(name) for module in modules for name in distributions[module]}
        assert {name.removesuffix("-cpu") for name in wanted} == {name.removesuffix("-cpu") for name in known}, extra


LACKING: list[tuple[str, list[object]]] = [
    ("igl", REGISTER), ("torch", ["inspect", FIELD]), ("trimesh", ["fit", FIELD, "out.safetensors"]),
    ("rq", ["worker"]), ("torch", ["worker"]), ("uvicorn", ["serve"]), ("torch", ["serve"]),
    ("rerun", [*REGISTER, "--recording", "chair.rrd"]),
]  # fmt: skip


@pytest.mark.parametrize(("module", "command"), LACKING)
def test_a_command_says_which_extra_it_lacks(
    run: Run, monkeypatch: pytest.MonkeyPatch, module: str, command: list[object]
) -> None:
    (extra,) = [name for name, modules in MODULES.items() if module in modules]
    monkeypatch.setitem(sys.modules, module, None)
    outcome = run(*command, code=3)
    assert outcome.stderr.strip() == f"EXTRA_MISSING not installed: {module}; pip install 'regnf[{extra}]'"


def test_both_extras_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("redis", "torch", "scipy"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"redis, torch, scipy; pip install 'regnf\[service,engine\]'"):
        require("service", "engine")


def test_without_any_extra_a_service_can_still_be_asked() -> None:
    """In a process that has loaded nothing yet: no command imports an extra's module before it needs it."""
    blocked = [module for modules in MODULES.values() for module in modules]
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({blocked!r})); sys.argv = ['regnf'] + sys.argv[1:];"
        "from regnf_cli.main import main; main()"
    )
    arguments = [str(argument) for argument in [*REGISTER, "--server", "http://127.0.0.1:1"]]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == 3, done.stderr
    assert "SERVICE_UNAVAILABLE " in done.stderr
    assert "Traceback" not in done.stderr

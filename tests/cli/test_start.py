"""What commands load: of libraries no more than they need."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from regnf_cli.commands import COMMANDS, app_of
from regnf_cli.main import _set_threads

DATA = Path(__file__).resolve().parents[2] / "examples" / "data"
NEEDED = {
    "PIL", "annotated_doc", "annotated_types", "click", "numpy", "pydantic", "pydantic_core", "regnf_cli", "regnf_core",
    "regnf_data", "regnf_fit", "rich", "safetensors", "scipy", "shellingham", "torch", "torchgen", "typer",
    "typing_extensions", "typing_inspection",
}  # fmt: skip
"""What `register` loads of its own and of others. torch itself loads torchgen, rich and numpy look for some more."""
SOUGHT = {"charset_normalizer", "cython_runtime", "pygments", "markdown_it", "mdurl", "colorama"}
CODE = """
import sys
sys.argv = ["regnf", *sys.argv[1:]]
from regnf_cli.main import command
try:
    code = command()
finally:
    names = {name.partition(".")[0] for name in sys.modules if not name.startswith("_")}
    print(*sorted(names - set(sys.stdlib_module_names)), file=sys.stderr)
sys.exit(code)
"""


def loaded(*arguments: str) -> set[str]:
    """The packages that a command has loaded when it ends, those of Python left out."""
    command = [sys.executable, "-c", CODE, *arguments]
    done = subprocess.run(command, cwd=DATA, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode in (0, 4), done.stderr
    return set(done.stderr.splitlines()[-1].split())


def test_register_loads_what_it_needs() -> None:
    pair = ["mix-room.safetensors", "dining-chair.safetensors", "--detection", "detection-dining-chair.json", "--json"]
    found = loaded("register", *pair)
    assert found >= {"torch", "regnf_core"}
    assert found - NEEDED - SOUGHT == set()


@pytest.mark.parametrize("command", [[], ["register"], ["serve"]])
def test_help_loads_neither_torch_nor_http(command: list[str]) -> None:
    heavy = {"torch", "numpy", "scipy", "httpx", "regnf_client", "fastapi", "PIL", "redis", "yaml"}
    assert not loaded(*command, "--help") & heavy


@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("regnf", {"regnf", "regnf_core"}),
        (
            "regnf_cli.supervisor",
            {
                "annotated_types", "dotenv", "pydantic", "pydantic_core", "pydantic_settings", "regnf_cli",
                "regnf_core", "regnf_service", "regnf_state", "typing_extensions", "typing_inspection",
            },
        ),
    ],
)  # fmt: skip
def test_modules_load_what_they_need(module: str, allowed: set[str]) -> None:
    """The supervisor starts its processes before it loads what talks to Redis and to the storage."""
    code = f"import sys; before = set(sys.modules); import {module}; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    names = {name.partition(".")[0] for name in done.stdout.split() if not name.startswith("_")}
    assert names - set(sys.stdlib_module_names) <= allowed


def test_every_command_is_there_whatever_is_asked_for() -> None:
    assert [one.name for one in app_of().registered_commands] == list(COMMANDS)
    assert [one.name for one in app_of(["search"]).registered_commands] == ["search"]


@pytest.mark.parametrize(
    ("command", "said", "threads"),
    [("register", None, "1"), ("register", "2", "2"), ("edit", None, "1"), ("fit", None, None)],
)
def test_commands_of_small_operations_use_one_thread(
    command: str, said: str | None, threads: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """torch reads it when it loads; what the user set stays."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if said is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", said)
    monkeypatch.setattr(sys, "argv", ["regnf", command])
    _set_threads()
    assert os.environ.get("OMP_NUM_THREADS") == threads

"""The images: linted, small, without root, and torch only where it belongs. No container engine is needed."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from itertools import takewhile
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.docker.files import DOCKERFILES, ROOT, command_of, copied_sources, instructions, last_stage
from tests.packaging.environments import build_wheel

every_image = pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.stem)
SERVICE, WORKER = DOCKERFILES


@every_image
def test_each_image(path: Path) -> None:
    """Linted, on the pinned base, without root, with its health; each install constrained, all sources sent."""
    linter = Path(sys.executable).with_name("hadolint")
    run = subprocess.run([linter, path], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout + run.stderr) == (0, "")
    bases = [rest for name, rest in instructions(path) if name == "FROM"]
    assert bases == ["${BASE} AS wheel", "${BASE} AS build", "${BASE}"]
    assert instructions(path)[0] == ("ARG", "BASE=python:3.11-slim-bookworm")
    assert any(name == "COPY" and rest.startswith("--from=build ") for name, rest in last_stage(path))
    assert not any("pip " in rest for _, rest in last_stage(path))
    assert [rest for name, rest in last_stage(path) if name == "USER"] == ["10001:10001"]
    assert [name for name, _ in last_stage(path)].count("HEALTHCHECK") == 1
    assert any(name == "RUN" and "--uid 10001" in rest and "--gid 10001" in rest for name, rest in last_stage(path))
    installs = [rest for name, rest in instructions(path) if name == "RUN" and "pip install" in rest]
    assert installs
    assert all("--constraint constraints.txt" in rest for rest in installs)
    python, *arguments = command_of(path)
    assert python == "python"
    if arguments[0] == "-m":
        assert importlib.util.find_spec(arguments[1]) is not None
    else:
        copies = [rest.split() for name, rest in last_stage(path) if name == "COPY"]
        (source,) = [words[0] for words in copies if words[-1] == arguments[0]]
        assert (ROOT / source).is_file()
    sent = {str(name) for name in sent_files()}
    assert set(copied_sources(path)) <= sent | {"."}


def test_torch_is_only_where_it_belongs() -> None:
    text = " ".join(rest for _, rest in instructions(SERVICE))
    assert not re.search(r"torch|open3d|engine|all\]", text)
    assert '"$(echo /wheels/regnf-*.whl)[service]"' in text
    text = " ".join(rest for _, rest in instructions(WORKER))
    assert '"$(echo /wheels/regnf-*.whl)[engine,service]"' in text
    wanted = re.search(r"runtime=\(([^)]*)\)", (ROOT / "scripts" / "system-packages.sh").read_text())
    assert wanted is not None
    assert set(wanted[1].split()) <= set(text.split())
    wheels = [takewhile(lambda step: step != ("FROM", "${BASE} AS build"), instructions(path)) for path in DOCKERFILES]
    service, worker = map(list, wheels)
    assert service == worker
    assert ("RUN", "/opt/build/bin/pip wheel --no-deps --wheel-dir /wheels .") in service


def admitted() -> list[str]:
    """The patterns of what .dockerignore lets through; it keeps back everything else."""
    patterns = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    assert patterns[0] == "*"
    return [pattern[1:] for pattern in patterns if pattern.startswith("!")]


def sent_files() -> list[Path]:
    """Every file that is sent to the builder, but what is compiled here."""
    places = [place for pattern in admitted() for place in ROOT.glob(pattern)]
    files = [path for place in places for path in (place, *place.rglob("*")) if path.is_file()]
    return [path.relative_to(ROOT) for path in files if path.suffix not in (".pyc", ".so")]


@pytest.mark.long
def test_the_builder_is_sent_what_the_wheel_is_made_of(tmp_path: Path) -> None:
    for name in sent_files():
        (tmp_path / "sent" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / "sent" / name)
    with ZipFile(build_wheel(tmp_path, tmp_path / "sent")) as made, ZipFile(build_wheel(tmp_path / "all")) as whole:
        assert sorted(made.namelist()) == sorted(whole.namelist())


def test_the_builder_is_sent_no_more_than_it_needs() -> None:
    folders = {name.parts[0] for name in sent_files()}
    assert not {"tests", "benchmarks", "deploy", ".ci", ".git", ".venv"} & folders
    assert {name.parts[1] for name in sent_files() if name.parts[0] == "docs"} & {"adr", "images", "reference"} == set()

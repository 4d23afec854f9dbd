"""Clean virtual environments without a package index: the wheel, and what its metadata asks for, and nothing else.

The dependencies of an extra are followed through the metadata of the installed distributions; each one's files are
linked into the new environment. A dependency that regnf needs and does not declare is missing there, as on a user's
machine.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from zipfile import ZipFile

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]


def build_wheel(folder: Path, source: Path = ROOT) -> Path:
    """The project's wheel, built from this checkout or a copy of it."""
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


def requirements_of(wheel: Path, extra: str) -> list[Requirement]:
    """What the wheel asks for with an extra ('' for none), its own extras resolved."""
    with ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        lines = archive.read(name).decode().splitlines()
    declared = [Requirement(line.removeprefix("Requires-Dist: ")) for line in lines if line.startswith("Requires-Dist")]
    found, extras = [], [extra]
    for wanted in extras:  # grows while it is read
        for requirement in declared:
            if requirement.marker is not None and not requirement.marker.evaluate({"extra": wanted}):
                continue
            if canonicalize_name(requirement.name) == "regnf":
                extras += [name for name in sorted(requirement.extras) if name not in extras]
            else:
                found.append(requirement)
    return found


def closure(requirements: list[Requirement]) -> dict[str, Distribution]:
    """The installed distributions that requirements lead to, by name."""
    found: dict[str, Distribution] = {}
    done: set[tuple[str, str]] = set()
    waiting = [(requirement, extra) for requirement in requirements for extra in ("", *requirement.extras)]
    while waiting:
        requirement, extra = waiting.pop()
        name = canonicalize_name(requirement.name)
        if (name, extra) in done:
            continue
        done.add((name, extra))
        try:
            found[name] = distribution(requirement.name)
        except PackageNotFoundError:
            continue  # what the environment of the tests does without, such as GPU libraries
        for line in found[name].requires or []:
            needed = Requirement(line)
            if needed.marker is None or needed.marker.evaluate({"extra": extra}):
                waiting += [(needed, wanted) for wanted in ("", *needed.extras)]
    return found


def clean_environment(folder: Path, wheel: Path, extra: str) -> Path:
    """A new environment with the wheel and the extra's dependencies; returns its folder of programs."""
    venv.create(folder, with_pip=False, symlinks=True)
    (packages,) = folder.glob("lib/python3*/site-packages")
    for dist in closure(requirements_of(wheel, extra)).values():
        for top in {file.parts[0] for file in dist.files or [] if file.parts[0] not in ("..", "__pycache__")}:
            source, target = Path(str(dist.locate_file(top))), packages / top
            if source.is_dir():
                shutil.copytree(source, target, copy_function=_link, dirs_exist_ok=True)
            elif source.exists() and not target.exists():
                _link(source, target)
    install_wheel(folder, wheel)
    return folder / "bin"


def _link(source: str | Path, target: str | Path) -> None:
    """A hard link, or a copy where the file system gives none. The import gate does not follow symbolic links out."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def install_wheel(venv_folder: Path, wheel: Path) -> None:
    """Install one wheel into an environment, without its dependencies and without an index."""
    command = [sys.executable, "-m", "pip", "--python", str(venv_folder / "bin" / "python"), "--quiet"]
    command += ["install", "--no-index", "--no-deps", "--disable-pip-version-check", str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def run(command: list[str | Path], folder: Path, timeout_s: float = 280.0) -> subprocess.CompletedProcess[str]:
    """Run a program of a clean environment, away from the checkout and from this process' Python settings."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "REGNF_"))}
    environment |= {"HOME": str(folder), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [str(part) for part in command],
        cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=timeout_s,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip

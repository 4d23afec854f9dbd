"""The wheel: what is in it, what its metadata says, and that it works in an environment with nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest

from regnf_cli.manual import pages_of
from regnf_cli.serve import FILES
from regnf_core.version import __version__
from scripts import wheel_hook
from tests.packaging.environments import ROOT, build_wheel, clean_environment, install_wheel, run

pytestmark = [pytest.mark.long, pytest.mark.xdist_group("packaging")]
PACKAGES = {
    "regnf", "regnf_cli", "regnf_client", "regnf_core", "regnf_data",
    "regnf_fit", "regnf_service", "regnf_state", "regnf_worker",
}  # fmt: skip
FOLDERS = {"regnf_service": "service/regnf_service", "regnf_worker": "worker/regnf_worker"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    with ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_it_holds_our_packages_the_demo_the_manual_and_nothing_else(names: set[str]) -> None:
    tops = {name.split("/")[0] for name in names}
    assert tops == PACKAGES | {f"regnf-{__version__}.dist-info"}
    assert not [name for name in names if "__pycache__" in name or "/tests/" in name]
    assert wheel_hook.FILES == FILES
    assert {f"regnf_cli/demo_files/{name}" for name in FILES} <= names
    # Those that a checkout shows: the wheel's list and the command's are made in different ways.
    assert {f"regnf_cli/manual_pages/{name}.md" for name in pages_of(ROOT / "docs")} <= names
    assert {"families.md", "how-to/batch.md"} <= set(wheel_hook.pages(ROOT))


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_every_file_of_a_package_is_in_it(names: set[str], package: str) -> None:
    folder = ROOT / FOLDERS.get(package, package)
    files = subprocess.run(["git", "ls-files", "."], cwd=folder, capture_output=True, text=True, check=True)
    wanted = {f"{package}/{line}" for line in files.stdout.splitlines()}
    assert f"{package}/py.typed" in wanted
    assert wanted - names == set()


def test_the_metadata_is_complete_and_names_no_address(wheel: Path) -> None:
    command = [sys.executable, "-m", "twine", "check", "--strict", str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    with ZipFile(wheel) as archive:
        metadata = Parser().parsestr(archive.read(f"regnf-{__version__}.dist-info/METADATA").decode())
    assert metadata["Author"] == "regnf contributors"
    assert metadata["Project-URL"] is None
    assert metadata["Home-page"] is None
    assert "Typing :: Typed" in metadata.get_all("Classifier", [])


@pytest.fixture(scope="module")
def base(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clean_environment(tmp_path_factory.mktemp("base") / "venv", wheel, "")


def test_without_extras_the_command_line_answers(base: Path, tmp_path: Path) -> None:
    assert run([base / "regnf", "--version"], tmp_path).stdout.strip() == __version__
    assert "register" in run([base / "regnf", "--help"], tmp_path).stdout


@pytest.mark.parametrize(
    ("command", "extra"),
    [(["demo"], "service,engine,embedded"), (["inspect", "x.ckpt"], "engine"), (["worker"], "service,engine")],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_without_extras_a_command_names_the_extra_it_needs(
    base: Path, tmp_path: Path, command: list[str], extra: str
) -> None:
    (tmp_path / "x.ckpt").write_bytes(b"PK\x03\x04 not a whole archive")
    done = run([base / "regnf", *command], tmp_path)
    assert done.returncode == 3
    assert "EXTRA_MISSING" in done.stderr
    assert f"regnf[{extra}]" in done.stderr
    assert "Traceback" not in done.stderr


def test_with_the_engine_alone_a_registration_runs(wheel: Path, tmp_path: Path) -> None:
    programs = clean_environment(tmp_path / "venv", wheel, "engine")
    examples = shutil.copytree(ROOT / "examples", tmp_path / "examples")
    done = run([programs / "python", examples / "01_register.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("registered"), done.stdout
    missing = run([programs / "regnf", "serve"], tmp_path)
    assert "EXTRA_MISSING" in missing.stderr
    assert "regnf[service" in missing.stderr


def test_with_the_service_alone_the_application_loads(wheel: Path, tmp_path: Path) -> None:
    """Each module of the front end and of what it shares with the workers is imported; no torch is there to load."""
    programs = clean_environment(tmp_path / "venv", wheel, "service")
    code = (
        "import importlib, pkgutil, regnf_service, regnf_state\n"
        "for package in (regnf_service, regnf_state):\n"
        "    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        importlib.import_module(module.name)\n"
        "from regnf_service.http.routes.pages import WEB\n"
        "print(sorted(path.suffix for path in WEB.glob('*') if path.is_file()))\n"
    )
    done = run([programs / "python", "-c", code], tmp_path)
    assert done.returncode == 0, done.stderr
    assert ".html" in done.stdout


PAGE = """
import pathlib, sys, httpx
from regnf_cli.demo import running_service
with running_service(pathlib.Path("state")) as address:
    for path in sys.argv[1:]:
        answer = httpx.get(address + path)
        print(answer.status_code, answer.headers["content-type"].split(";")[0], path)
"""


@pytest.mark.timeout(600)
def test_with_everything_the_demo_and_the_page_work(wheel: Path, tmp_path: Path) -> None:
    programs = clean_environment(tmp_path / "venv", wheel, "all")
    done = run([programs / "regnf", "demo", "--exit"], tmp_path)
    assert done.returncode == 0, done.stderr + done.stdout
    assert "registered" in done.stdout
    assert not list(tmp_path.glob("*.demo")), "the demo leaves nothing behind"
    page = run([programs / "python", "-c", PAGE, "/", "/static/js/viewer.js", "/openapi.yaml"], tmp_path)
    lines = page.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["200"] * 3, page.stdout + page.stderr
    assert lines[1].split()[1].endswith("javascript")


def test_type_checkers_see_the_types_of_an_editable_install(tmp_path: Path) -> None:
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    code = "import sys; from hatchling.build import build_editable; print(build_editable(sys.argv[1]))"
    built = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, check=True, capture_output=True, text=True
    )
    install_wheel(venv, tmp_path / built.stdout.split()[-1])
    user = tmp_path / "user.py"
    user.write_text("import regnf_service.server, regnf_worker.main\nfrom regnf_core import Sim3\nreveal_type(Sim3)\n")
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--python-executable"]
    command += [str(venv / "bin/python"), "--cache-dir", str(tmp_path / "cache")]
    done = run([*command, str(user)], tmp_path, timeout_s=280.0)
    assert "regnf_core.geometry.sim3.Sim3" in done.stdout, done.stdout + done.stderr
    assert "import-untyped" not in done.stdout
    assert "import-not-found" not in done.stdout, done.stdout

"""scripts/sbom.sh: the bill of materials names every pin, and no scan that was not done passes for one that was."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.utils import canonicalize_name

from regnf_core.version import __version__

ROOT = Path(__file__).resolve().parents[2]
TOOLS = Path(os.environ.get("REGNF_SBOM_TOOLS", ROOT / "build" / "sbom-tools"))
NOT_DONE = 3


def sbom(*arguments: str | Path, tools: Path = TOOLS) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [ROOT / "scripts" / "sbom.sh", *map(str, arguments)],
        env=os.environ | {"REGNF_SBOM_TOOLS": str(tools)},
        capture_output=True,
        text=True,
        check=False,
    )


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    split = (line.partition("==") for line in lines if "==" in line and not line.startswith("#"))
    return {canonicalize_name(name): pinned.split(";")[0].strip() for name, _, pinned in split}


def installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False  # of another Python, or of an extra that this environment lacks
    return True


@pytest.mark.skipif(not (TOOLS / "bin" / "cyclonedx-py").exists(), reason="run scripts/sbom.sh tools first")
def test_the_bill_of_materials_lists_every_pin(tmp_path: Path) -> None:
    done = sbom("bom", sys.executable, tmp_path / "bom.json")
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "bom.json").read_text(encoding="utf-8"))
    assert document["bomFormat"] == "CycloneDX"
    # a build for CPUs alone says so behind a plus: 2.13.0+cpu
    listed = {canonicalize_name(one["name"]): one["version"].split("+")[0] for one in document["components"]}
    expected = {name: pinned for name, pinned in pins().items() if installed(name)}
    assert len(expected) > 100
    assert {name: listed.get(name) for name in expected} == expected


@pytest.fixture
def tools(tmp_path: Path) -> Path:
    """Tools of which pip-audit does what a test says."""
    (tmp_path / "tools" / "bin").mkdir(parents=True)
    (tmp_path / "tools" / "bin" / "python").symlink_to(sys.executable)
    return tmp_path / "tools"


def audit_finds(tools: Path, found: dict[str, Any] | None, status: int) -> None:
    """pip-audit leaves these findings, none at all where it had no answer, and ends with this status."""
    program = tools / "bin" / "pip-audit"
    write = "" if found is None else f"open(sys.argv[sys.argv.index('--output') + 1], 'w').write({json.dumps(found)!r})"
    program.write_text(f"#!{sys.executable}\nimport sys\n{write}\nsys.exit({status})\n", encoding="utf-8")
    program.chmod(0o755)


def bill(folder: Path) -> Path:
    components = [{"name": name, "version": "1.0"} for name in ("one", "two")]
    (folder / "bom.json").write_text(json.dumps({"components": components}), encoding="utf-8")
    return folder / "bom.json"


def package(name: str, *advisories: str) -> dict[str, Any]:
    return {"name": name, "version": "1.0", "vulns": [{"id": one} for one in advisories]}


@pytest.mark.parametrize(
    ("found", "status", "expected", "said"),
    [
        ({"dependencies": [package("one"), package("two")]}, 0, 0, "2 packages, 0 advisories"),
        ({"dependencies": [package("one", "X-1"), package("two")]}, 1, 1, "one 1.0: X-1"),
        (None, 1, NOT_DONE, "NOT DONE"),
        (None, 0, NOT_DONE, "NOT DONE"),
        ({"dependencies": [package("one")]}, 0, NOT_DONE, "NOT DONE for all: 1 of 2"),
        (
            {"dependencies": [package("one"), {"name": "two", "skip_reason": "?"}]},
            0,
            NOT_DONE,
            "NOT DONE for all: 1 of 2",
        ),
    ],
)
def test_a_scan_says_what_it_has_done(
    tools: Path, tmp_path: Path, found: dict[str, Any] | None, status: int, expected: int, said: str
) -> None:
    audit_finds(tools, found, status)
    done = sbom("scan", bill(tmp_path), tools=tools)
    assert (done.returncode, said in done.stdout + done.stderr) == (expected, True), done.stdout + done.stderr


def test_without_tools_nothing_passes(tmp_path: Path) -> None:
    for what in (("scan", bill(tmp_path)), ("bom", sys.executable, tmp_path / "made.json")):
        done = sbom(*what, tools=tmp_path / "none")
        assert done.returncode == NOT_DONE
        assert "NOT DONE" in done.stderr


def test_the_tools_are_pinned_and_one_place_says_the_version() -> None:
    lines = (ROOT / "scripts" / "sbom-tools.txt").read_text(encoding="utf-8").splitlines()
    assert all(line.count("==") == 1 for line in lines)
    assert {"cyclonedx-bom", "pip_audit"} <= {line.partition("==")[0] for line in lines}
    chart = yaml.safe_load((ROOT / "deploy/helm/regnf/Chart.yaml").read_text(encoding="utf-8"))
    contract = yaml.safe_load((ROOT / "openapi.yaml").read_text(encoding="utf-8"))
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## \[(\d+\.\d+\.\d+)\]", changelog, flags=re.M)
    assert newest is not None
    assert {chart["appVersion"], contract["info"]["version"], newest[1]} == {__version__}

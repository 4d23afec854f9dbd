"""The import rules of the house: who may know whom."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HTTP = {"fastapi", "starlette", "uvicorn"}
OURS = {"regnf_core", "regnf_fit", "regnf_data", "regnf_state", "regnf_service", "regnf_worker", "regnf_cli"}
HEAVY = {"torch", "open3d", "igl", "trimesh"}
FOLDERS = {"regnf_service": "service/regnf_service", "regnf_worker": "worker/regnf_worker"}
FORBIDDEN = {
    "regnf_core": HTTP | {"rq", "redis"} | OURS - {"regnf_core"},
    "regnf_data": HTTP | {"rq", "redis"} | OURS - {"regnf_core", "regnf_data"},
    "regnf_fit": HTTP | {"rq", "redis"} | OURS - {"regnf_core", "regnf_data", "regnf_fit"},
    "regnf_state": HTTP | HEAVY | OURS - {"regnf_core", "regnf_state"},
    "regnf_service": HEAVY | {"regnf_worker", "regnf_cli", "regnf_fit", "regnf_data"},
    "regnf_worker": HTTP | {"regnf_service", "regnf_cli", "regnf_fit", "regnf_data"},
}


def imports_of(path: Path) -> Iterator[str]:
    """Every module a file imports, at whatever depth of the code; ``from a import b`` names both a and a.b."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_no_package_imports_what_it_must_not_know(package: str) -> None:
    files = sorted((ROOT / FOLDERS.get(package, package)).rglob("*.py"))
    assert files
    broken = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in files
        for name in imports_of(path)
        if name.split(".")[0] in FORBIDDEN[package]
    }
    assert not broken


def modules_of(package: str) -> dict[str, Path]:
    """Every module of a package by its dotted name."""
    files = (ROOT / FOLDERS.get(package, package)).rglob("*.py")
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


@pytest.mark.parametrize("package", ["regnf_core", "regnf_fit", "regnf_data"])
def test_no_two_modules_import_each_other(package: str) -> None:
    modules = modules_of(package)
    imported = {name: set(imports_of(path)) - {name} for name, path in modules.items()}
    pairs = {(a, b) for a in modules for b in imported[a] & modules.keys() if a < b and a in imported[b]}
    assert not pairs


def test_descriptions_know_nothing_of_what_evaluates_them() -> None:
    """``regnf_core.schema`` is plain data: it imports itself, the errors and the writing of files."""
    allowed = ("regnf_core.schema", "regnf_core.errors", "regnf_core.files")
    broken = {
        f"{module} imports {name}"
        for module, path in modules_of("regnf_core").items()
        if module.startswith("regnf_core.schema")
        for name in imports_of(path)
        if name.startswith("regnf_core.") and not name.startswith(allowed)
    }
    assert not broken


@pytest.mark.parametrize(
    "module", ["regnf_service.app", "regnf_worker.main", "regnf_worker.jobs", "regnf_core", "regnf_cli.main"]
)
def test_light_modules_load_without_torch(module: str) -> None:
    code = f"import sys, {module}; heavy = {{'torch', 'open3d'}} & set(sys.modules); sys.exit(', '.join(heavy) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_public_names_exist() -> None:
    import regnf_core

    assert sorted(regnf_core.__all__) == regnf_core.__all__
    for name in regnf_core.__all__:
        assert getattr(regnf_core, name) is not None

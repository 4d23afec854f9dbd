"""The import rules of the house: who may know whom."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HTTP = {"fastapi", "starlette", "uvicorn"}
OURS = {
    "regnf", "regnf_cli", "regnf_client", "regnf_core", "regnf_data",
    "regnf_fit", "regnf_service", "regnf_state", "regnf_worker",
}  # fmt: skip
HEAVY = {"torch", "open3d", "igl", "trimesh"}
FOLDERS = {"regnf_service": "service/regnf_service", "regnf_worker": "worker/regnf_worker"}
FORBIDDEN = {
    "regnf": HTTP | {"rq", "redis", "regnf_cli", "regnf_service", "regnf_state", "regnf_worker"},
    "regnf_client": HTTP | HEAVY | {"rq", "redis"} | OURS - {"regnf_client", "regnf_core"},
    "regnf_core": HTTP | {"rq", "redis"} | OURS - {"regnf_core"},
    "regnf_data": HTTP | {"rq", "redis"} | OURS - {"regnf_core", "regnf_data"},
    "regnf_fit": HTTP | {"rq", "redis"} | OURS - {"regnf_core", "regnf_data", "regnf_fit"},
    "regnf_state": HTTP | HEAVY | OURS - {"regnf_core", "regnf_state"},
    "regnf_service": HEAVY | {"regnf_worker", "regnf_cli", "regnf_client", "regnf_fit", "regnf_data"},
    "regnf_worker": HTTP | {"regnf_service", "regnf_cli", "regnf_client"},
}


MAX_PARAMETERS = 10


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Every module a file imports, at whatever depth of the code; ``from a import b`` names both a and a.b."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


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
    folder = ROOT / FOLDERS.get(package, package)
    named = {path: (package, *path.relative_to(folder).with_suffix("").parts) for path in sorted(folder.rglob("*.py"))}
    return {".".join(parts).removesuffix(".__init__"): path for path, parts in named.items()}


MODULES = {name: path for package in sorted(OURS) for name, path in modules_of(package).items()}


def children_of(package: str) -> dict[str, set[str]]:
    """Which of a package's direct children, modules and subpackages, import which others, at whatever depth.

    Imports of all kinds count: at the top of a file, under TYPE_CHECKING, within functions.
    """
    edges: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        if not module.startswith(f"{package}."):
            continue
        own = child_of(package, module)
        edges.setdefault(own, set())
        for name in imports_of(path):
            if name in MODULES and name.startswith(f"{package}.") and child_of(package, name) != own:
                edges[own].add(child_of(package, name))
    return edges


def child_of(package: str, module: str) -> str:
    return module.removeprefix(f"{package}.").split(".")[0]


def cycle_in(edges: Mapping[str, AbstractSet[str]]) -> list[str]:
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_import_cycle_of_any_kind() -> None:
    """Neither modules nor the folders that hold them import each other, directly or in a circle, in any package."""
    modules = {module: (imports_of(path) & MODULES.keys()) - {module} for module, path in MODULES.items()}
    assert cycle_in(modules) == []
    packages = {module.rpartition(".")[0] for module in MODULES if "." in module}
    assert {package: cycle for package in packages if (cycle := cycle_in(children_of(package)))} == {}


def outside(module: str, package: str) -> bool:
    return not f"{module}.".startswith(f"{package}.")


def test_the_presets_know_nothing_of_each_other() -> None:
    paper, robust = "regnf_core.paper", "regnf_core.robust"
    broken = {
        f"{module} imports {name}"
        for module, path in MODULES.items()
        for name in imports_of(path)
        if (not outside(module, paper) and not outside(name, robust))
        or (not outside(module, robust) and not outside(name, paper))
    }
    assert not broken


def test_the_published_method_has_one_entrance() -> None:
    """Outside of ``regnf_core.paper`` only its pipeline is imported, and only where a preset is chosen."""
    users = {
        (module, name)
        for module, path in MODULES.items()
        if outside(module, "regnf_core.paper")
        for name in imports_of(path)
        if not outside(name, "regnf_core.paper")
    }
    assert users == {("regnf_core.library", "regnf_core.paper"), ("regnf_core.library", "regnf_core.paper.pipeline")}


def too_many_parameters(module: str, path: Path) -> Iterator[str]:
    """The functions of a module with more than MAX_PARAMETERS parameters, self and cls left out."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        given = node.args
        every = [*given.posonlyargs, *given.args, *given.kwonlyargs]
        names = [arg.arg for arg in (*every, given.vararg, given.kwarg) if arg is not None]
        count = len([name for name in names if name not in ("self", "cls")])
        name = "lambda" if isinstance(node, ast.Lambda) else node.name
        if count > MAX_PARAMETERS:
            yield f"{module}.{name}"


def commands() -> set[str]:
    """The functions that typer makes commands of: their parameters are the options that a user reads in --help."""
    from regnf_cli.commands import app_of

    app = app_of()
    groups = [app, *(group.typer_instance for group in app.registered_groups if group.typer_instance is not None)]
    callbacks = [command.callback for group in groups for command in group.registered_commands]
    return {f"{callback.__module__}.{callback.__name__}" for callback in callbacks if callback is not None}


def test_no_function_has_more_parameters_than_a_reader_keeps_in_mind() -> None:
    found = {name for module, path in MODULES.items() for name in too_many_parameters(module, path)}
    assert not found - commands()


def test_descriptions_know_nothing_of_what_evaluates_them() -> None:
    """``regnf_core.schema`` is plain data: it imports itself, the errors and the writing of files."""
    allowed = ("regnf_core.schema", "regnf_core.errors")
    broken = {
        f"{module} imports {name}"
        for module, path in modules_of("regnf_core").items()
        if module.startswith("regnf_core.schema")
        for name in imports_of(path)
        if name.startswith("regnf_core.") and not name.startswith(allowed)
    }
    assert not broken


def test_light_modules_load_without_torch() -> None:
    light = "regnf_service.server, regnf_worker.main, regnf_worker.jobs, regnf_cli.main, regnf_client, regnf"
    code = f"import sys, {light}; sys.exit(', '.join({{'torch', 'open3d'}} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_public_names_exist() -> None:
    import regnf
    import regnf_client
    import regnf_core

    for package in (regnf, regnf_client, regnf_core):
        assert len(set(package.__all__)) == len(package.__all__)
        for name in package.__all__:
            assert getattr(package, name) is not None
    assert set(regnf_core.__all__) < set(regnf.__all__)

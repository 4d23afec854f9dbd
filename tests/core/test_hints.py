"""What a person is told to do next: for every reason something, and nothing that is not there. The manual has all."""

from __future__ import annotations

import ast
import json
import re
import subprocess
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path

import pytest
import typer

from regnf_cli.commands import app_of
from regnf_core.errors import _FAMILIES, HINTS, VERDICT_REASONS, InvalidOptionsError, hint_of, verdict_hint
from regnf_core.importing.containers.sniff import explain_refusal, sniff_format
from regnf_core.importing.upload_description import UploadDescription
from regnf_core.options import RegistrationOptions, _names
from regnf_core.rendering.request import RenderOptions
from regnf_core.rotations import similarity_fault
from regnf_state.reasons import REASONS
from regnf_state.settings import Settings

ROOT = Path(__file__).parents[2]
PACKAGES = ("regnf", "regnf_cli", "regnf_client", "regnf_core", "regnf_data", "regnf_fit", "regnf_state", "worker")
COMMANDS_NAMED = re.compile(r"(?:`|: )regnf ([a-z-]+)((?: [^`']*)?)")
HAVE_IT_IN_THEIR_MESSAGE = {"EXTRA_MISSING", "USAGE", "CANCELLED"}
"""Or are no errors that anything could be done about."""


@cache
def trees() -> list[tuple[Path, ast.Module]]:
    paths = [path for top in (*PACKAGES, "service") for path in sorted((ROOT / top).rglob("*.py"))]
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in paths]


@cache
def texts() -> list[tuple[Path, str]]:
    """Every literal text of the code that is a hint: of the table, or given by the name ``hint``."""
    found = [(ROOT / "regnf_core/errors.py", text) for text in (*HINTS.values(), *_FAMILIES.values())]
    for path, tree in trees():
        for node in ast.walk(tree):
            is_hint = isinstance(node, ast.keyword) and node.arg == "hint"
            is_kept = isinstance(node, ast.Assign) and "hint" in ast.unparse(node.targets[0]).lower()
            if isinstance(node, ast.keyword | ast.Assign) and (is_hint or is_kept):
                constants = [one for one in ast.walk(node.value) if isinstance(one, ast.Constant)]
                found += [(path, one.value) for one in constants if isinstance(one.value, str)]
    return found


def reasons() -> Iterator[str]:
    for path, tree in trees():
        for node in ast.walk(tree) if ROOT / "service" not in path.parents else ():
            if isinstance(node, ast.keyword) and node.arg == "reason" and isinstance(node.value, ast.Constant):
                yield str(node.value.value)


def constants() -> Iterator[tuple[ast.AST, str]]:
    """Every literal text of the code, with what it stands in."""
    for _, tree in trees():
        for node in ast.walk(tree):
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.Constant) and isinstance(child.value, str):
                    yield node, child.value


def reasons_of_classes() -> Iterator[str]:
    """Those that errors have by their class, or as the default of a function that makes them."""
    for node, text in constants():
        is_default = isinstance(node, ast.arguments) and "reason" in {one.arg for one in node.args}
        is_assigned = isinstance(node, ast.Assign | ast.AnnAssign) and "reason" in ast.unparse(node).partition("=")[0]
        if (is_assigned or is_default) and re.fullmatch(r"[A-Z]+(_[A-Z]+)+", text):
            yield text


def hinted_on_the_spot() -> set[str]:
    """Reasons of which each use of the code gives a hint of its own."""
    always: dict[str, bool] = {}
    for path, tree in trees():
        for node in ast.walk(tree) if ROOT / "service" not in path.parents else ():
            if isinstance(node, ast.Call):
                said = {one.arg: one.value for one in node.keywords}
                reason = said.get("reason")
                if isinstance(reason, ast.Constant):
                    name = str(reason.value)
                    always[name] = always.get(name, True) and "hint" in said
    return {name for name, every in always.items() if every}


def test_every_reason_has_a_hint() -> None:
    named = set(reasons())
    assert len(named) > 100
    assert {one for one in named if hint_of(one) is None} - hinted_on_the_spot() - HAVE_IT_IN_THEIR_MESSAGE == set()


def test_the_manual_lists_every_reason_and_no_other() -> None:
    pages = [path for path in (ROOT / "docs").rglob("*.md") if "adr" not in path.parts]
    manual = {path.name: path.read_text(encoding="utf-8") for path in pages}
    named = {*reasons(), *reasons_of_classes(), *HINTS, *REASONS}
    assert len(named) > 200
    assert {one for one in named if not any(f"`{one}`" in text for text in manual.values())} == set()
    tables = [
        line
        for name in ("errors.md", "import-gate.md", "datasets.md", "fitting.md")
        for line in manual[name].splitlines()
    ]
    first = {
        one
        for line in tables
        if line.startswith("| `")
        for one in re.findall(r"`([A-Z]+(?:_[A-Z]+)+)`", line.split("|")[1])
    }
    written = {word for _, text in constants() for word in re.findall(r"[A-Z][A-Z0-9_]+", text)}
    assert len(first) > 200
    assert first - written == set()


def test_every_page_that_a_hint_names_is_there() -> None:
    named = {page for _, text in texts() for page in re.findall(r"\bdocs/[a-z0-9/-]+\.md\b", text)}
    assert len(named) > 5
    assert {page for page in named if not (ROOT / page).is_file()} == set()


def test_every_command_that_a_hint_names_is_there() -> None:
    app = typer.main.get_command(app_of())
    wrong = []
    for path, text in texts():
        for name, rest in COMMANDS_NAMED.findall(text):
            command = app.commands.get(name)  # type: ignore[attr-defined]
            known = {option for one in getattr(command, "params", ()) for option in one.opts} | {"--help"}
            options = re.findall(r"--[a-z-]+", rest)
            if command is None or (not hasattr(command, "commands") and not set(options) <= known):
                wrong.append((path.name, text))
    assert wrong == []


def test_every_option_and_setting_that_a_hint_names_is_there() -> None:
    options = {".".join((*group, name)) for group, names in _names().items() for name in names}
    options |= {one.name for one in fields(RenderOptions)}
    imports = {one.name for one in fields(UploadDescription)}
    settings = {f"REGNF_{name.upper()}" for name in Settings.model_fields} | {
        name for path in ROOT.glob("regnf_*/**/*.py") for name in re.findall(r'"(REGNF_[A-Z_]+)"', path.read_text())
    }
    for path, text in texts():
        for kind, name in re.findall(r"\b(import )?option ((?:robust\.)?[a-z]+_[a-z_]+)\b", text):
            assert name in (imports if kind else options), (path, text)
        for name in re.findall(r"REGNF_[A-Z_]*[A-Z]", text):
            assert name in settings, (path, name)


@pytest.mark.parametrize("axis", [None, "z"])
def test_an_option_that_is_given_is_not_asked_for(axis: str | None) -> None:
    hint = verdict_hint("SEVERAL_POSES_AGREE", {"up_axis": axis})
    assert ("set the option up_axis" in hint) == (axis is None)
    assert "alternatives" in hint


def test_a_transposed_matrix_is_recognized() -> None:
    rows = [[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 5], [0, 0, 0, 1]]
    assert similarity_fault(rows) is None
    assert "is it transposed?" in str(similarity_fault([list(column) for column in zip(*rows, strict=True)]))
    assert "transposed" not in str(similarity_fault([[1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 1, 5], [0, 0, 0, 2]]))


@pytest.mark.parametrize(
    "given",
    [
        {"robust": {"min_scale": "0.97"}},
        {"robust": {"min_scale": True}},
        {"optimization": {"iterations": "5"}},
        {"robust": {"rotations": "64"}},
    ],
    ids=json.dumps,
)
def test_a_text_is_no_number_in_options_either(given: dict[str, object]) -> None:
    with pytest.raises(InvalidOptionsError, match=r"is (a text|true or false), expected a number"):
        RegistrationOptions.from_dict(given)


def test_a_file_of_another_program_is_to_be_exported() -> None:
    head = b"\x01\x02\x03\x04some program's own" + bytes(500)
    assert sniff_format(head) is None
    assert ".glb, .ply, .obj or .stl" in HINTS[explain_refusal(head)[0]]


def test_the_scripts_of_the_setup_are_sound() -> None:
    for script in ("setup.sh", "run-tests.sh"):
        assert subprocess.run(["bash", "-n", ROOT / "scripts" / script], check=False).returncode == 0


# Every reason that an engine can give for its verdict is told in words.


CORE = Path(__file__).resolve().parents[2] / "regnf_core"


def test_the_table_holds_the_reasons_of_both_presets_and_no_others() -> None:
    given: set[str] = set()
    for source in (CORE / "paper" / "pipeline.py", *sorted((CORE / "robust" / "verdict").glob("*.py"))):
        text = source.read_text(encoding="utf-8")
        given |= set(re.findall(r'(?:"(?:registered|ambiguous|rejected)", |return |_Usual\()"([A-Z_]+)"', text))
    assert given == set(VERDICT_REASONS)

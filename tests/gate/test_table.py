"""bad-inputs.md says what the tests show: each test it names exists, and a file's row has its outcome."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from regnf_state.reasons import REASONS
from tests.gate.bad_containers import CONTAINERS
from tests.gate.bad_pickles import PICKLES
from tests.gate.bad_runs import RUNS
from tests.gate.bad_tensors import TENSORS

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_name("bad-inputs.md")
SECTIONS = ("Transport", "Names", "Container", "Runs", "Pickle", "Tensors", "Boxes", "Requests", "Recordings")
_WORD = re.compile(r"`([^`]+)`")
_REASON = re.compile(r"`([A-Z][A-Z0-9_]+)`")


@dataclass(frozen=True)
class Row:
    """One row of the page: what is sent, what is answered, and the tests' ids."""

    section: str
    given: str
    answer: str
    tests: tuple[str, ...]


@cache
def rows() -> tuple[Row, ...]:
    section, found = "", []
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            section = line.removeprefix("## ")
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if line.startswith("| ") and section in SECTIONS and cells[0] != "Input":
            found.append(Row(section, cells[0], cells[1], tuple(_WORD.findall(cells[2]))))
    return tuple(found)


@pytest.fixture
def collected(request: pytest.FixtureRequest) -> set[str]:
    """The id of every test in the files that the page names, with and without its parameters."""
    files = {test.partition("::")[0] for row in rows() for test in row.tests}
    ids = {f"{item.path.relative_to(ROOT).as_posix()}::{item.name}" for item in request.session.items}
    if not files <= {name.partition("::")[0] for name in ids}:  # this run has not collected them all
        ids = collect(sorted(files))
    return ids | {name.partition("[")[0] for name in ids} | files


def collect(files: list[str]) -> set[str]:
    command = [sys.executable, "-m", "pytest", "-o", "addopts=-p no:dash", "--collect-only", "-q", *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return {line for line in done.stdout.splitlines() if "::" in line}


def test_the_page_has_every_section() -> None:
    assert tuple(dict.fromkeys(row.section for row in rows())) == SECTIONS
    page = TABLE.read_text(encoding="utf-8")
    assert f"There are {len(rows())} rows." in page


def test_every_row_names_tests_that_exist(collected: set[str]) -> None:
    missing = {row.given: [test for test in row.tests if test not in collected] for row in rows()}
    assert {given: tests for given, tests in missing.items() if tests} == {}
    assert [row.given for row in rows() if not row.tests] == []


@pytest.mark.parametrize(
    ("test", "files"),
    [("test_container", CONTAINERS), ("test_pickle", PICKLES), ("test_tensors", TENSORS), ("test_run", RUNS)],
)
def test_every_bad_file_has_its_row_and_its_outcome(test: str, files: dict[str, tuple[object, str]]) -> None:
    said = {name: row for row in rows() for name in row.tests if name.startswith(f"tests/gate/test_files.py::{test}[")}
    for given, (_, outcome) in files.items():
        row = said.pop(f"tests/gate/test_files.py::{test}[{given}]")
        assert (row.given, row.answer.replace("`", "")) == (given, outcome)
    assert said == {}


def test_every_reason_is_one_that_is_documented() -> None:
    pages = [(ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("import-gate.md", "datasets.md")]
    known = set(REASONS).union(*map(_REASON.findall, pages))
    assert {reason for row in rows() for reason in _REASON.findall(row.answer)} <= known

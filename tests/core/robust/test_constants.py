"""Every tuned number of the preset says what it is and where it comes from, and stands in the table alone."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from regnf_core.robust import constants

TABLE = Path(constants.__file__)
SOURCES = (
    "derived",
    "published",
    "main pairs",
    "early fits",
    "library",
    "random worlds",
    "simulated frames",
    "by hand",
)
PLAIN = {0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 36, 0.5, 1.5, 9, 20, 180, 1e-9, 1e-6, 1009, 1.533751168755204288118041}
"""Counts, dimensions, halves, degrees, guards against a division by zero, the prime that separates seeds, the published
constant of the super-Fibonacci spirals, and a length of text in an error message."""


def comment_of(entry: ast.AnnAssign, lines: list[str]) -> str:
    """What stands beside a constant, or above it."""
    first, above = entry.lineno - 1, []
    while lines[first - 1].lstrip().startswith("#"):
        first -= 1
        above.insert(0, lines[first].strip(" #"))
    return " ".join([*above, lines[entry.lineno - 1].partition("  # ")[2]]).strip()


def test_every_constant_says_what_it_is_and_where_it_comes_from() -> None:
    text = TABLE.read_text(encoding="utf-8")
    found = {
        f"{group.name}.{ast.unparse(entry.target)}": comment_of(entry, text.splitlines())
        for group in ast.parse(text).body
        if isinstance(group, ast.ClassDef) and group.name.endswith("Constants")
        for entry in group.body
        if isinstance(entry, ast.AnnAssign)
    }
    assert len(found) > 100
    tag = re.compile(rf"\w.*\[({'|'.join(SOURCES)})[^\]]*\]$")
    assert [name for name, told in found.items() if not tag.search(told)] == []


@pytest.mark.parametrize("folder", ["", "search", "refine", "verdict"])
def test_no_tuned_number_stands_outside_of_the_table(folder: str) -> None:
    stray = [
        f"{path.name}: {ast.unparse(node)}"
        for path in sorted((TABLE.parent / folder).glob("*.py"))
        if path != TABLE
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in PLAIN
    ]
    assert stray == []

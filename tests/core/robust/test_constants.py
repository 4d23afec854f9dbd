"""Every tuned number of the preset says what it is and where it comes from, and stands in the table alone."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from regnf_core.robust import constants

TABLE = Path(constants.__file__).parent
SOURCES = ("derived", "published", "main pairs", "early fits", "library", "random worlds", "by hand")
PLAIN = {0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 36, 0.5, 1.5, 9, 20, 180, 1e-9, 1e-6, 1009, 1.533751168755204288118041}
"""Counts, dimensions, halves, degrees, guards against a division by zero, the prime that separates seeds, the published
constant of the super-Fibonacci spirals, and a length of text in an error message."""


def groups() -> Iterator[ast.ClassDef]:
    """The classes of the table, from all of its files: those whose members all have values."""
    for path in sorted(TABLE.glob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and all(
                entry.value is not None for entry in node.body if isinstance(entry, ast.AnnAssign)
            ):
                yield node


def entries() -> Iterator[tuple[str, str]]:
    """Name and description of every constant."""
    for group in groups():
        for entry, after in zip(group.body, [*group.body[1:], None], strict=True):
            if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name):
                told = after.value if isinstance(after, ast.Expr) else None
                text = told.value if isinstance(told, ast.Constant) and isinstance(told.value, str) else ""
                yield f"{group.name}.{entry.target.id}", " ".join(text.split())


def is_number(node: ast.AST) -> bool:
    """A number that is not among the plain ones; True and False are none."""
    return isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in PLAIN


def test_every_constant_says_what_it_is_and_where_it_comes_from() -> None:
    found = dict(entries())
    assert len(found) > 100
    tag = re.compile(rf"\[({'|'.join(SOURCES)})[^\]]*\]$")
    assert [name for name, text in found.items() if not tag.search(text)] == []


@pytest.mark.parametrize("folder", ["", "search", "refine", "verdict"])
def test_no_tuned_number_stands_outside_of_the_table(folder: str) -> None:
    stray = []
    for path in sorted((TABLE.parent / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if is_number(node):
                stray.append(f"{path.name}: {ast.unparse(node)}")
    assert stray == []

"""One mistake: what its message must name, what it must say was expected, and what it must say to do next."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest


@dataclass(frozen=True)
class Case:
    """``names``, ``expects`` and ``next`` are patterns; all three must be found in the message.

    name: of the test · reason: the stable word, and ``code`` the exit code or status
    """

    name: str
    reason: str
    code: int
    names: str
    expects: str
    next: str
    how: Any = None
    prepare: Callable[[Path], object] = field(default=lambda folder: None)

    def check(self, message: str) -> None:
        for what, pattern in (("names", self.names), ("expects", self.expects), ("next", self.next)):
            assert re.search(pattern, message, re.DOTALL), f"{what}: {pattern!r} is not in:\n{message}"
        assert "Traceback" not in message


def parametrized(cases: list[Case]) -> pytest.MarkDecorator:
    """One test for each case, of its name."""
    names = [case.name for case in cases]
    assert len(set(names)) == len(names)
    return pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in cases])

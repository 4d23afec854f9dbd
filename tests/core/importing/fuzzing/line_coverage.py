"""Which steps from line to line the gate's own modules have taken: the feedback of a fuzzer, in plain Python."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import Any

from regnf_core import importing

_FOLDER = str(next(iter(importing.__path__)))
_FAMILIES = os.path.join(_FOLDER, "families")
_Local = Callable[[FrameType, str, Any], Any]


class Coverage:
    """Collects steps (from line, to line) of the gate's own modules while a case runs.

    The families of checkpoints are left out: their searches would take most of the time and lead nowhere new.
    """

    def __init__(self) -> None:
        self.steps: set[tuple[CodeType, int, int]] = set()
        self._ours: dict[CodeType, bool] = {}

    @contextmanager
    def over(self) -> Iterator[None]:
        """Trace what runs inside."""
        sys.settrace(self._enter)
        try:
            yield
        finally:
            sys.settrace(None)

    def lines(self) -> int:
        """How many lines were reached."""
        return len({(code.co_filename, line) for code, _, line in self.steps})

    def _enter(self, frame: FrameType, *_: object) -> _Local | None:
        code = frame.f_code
        ours = self._ours.get(code)
        if ours is None:
            ours = self._ours[code] = code.co_filename.startswith(_FOLDER) and not code.co_filename.startswith(
                _FAMILIES
            )
        return self._tracer(code) if ours else None

    def _tracer(self, code: CodeType) -> _Local:
        before, steps = 0, self.steps

        def step(frame: FrameType, event: str, _: Any) -> _Local:
            nonlocal before
            if event == "line":
                line = frame.f_lineno
                steps.add((code, before, line))
                before = line
            return step

        return step

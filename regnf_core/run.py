"""Progress reports and the seconds of each phase, the same for every preset."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from regnf_core.result import Phase, ProgressCallback

STARTS: dict[Phase, float] = {
    "sampling": 0.0,
    "initialising": 0.15,
    "optimising": 0.2,
    "verifying": 0.95,
    "exporting": 0.98,
}
"""The overall share done when each phase begins."""


class Run:
    """Progress reports and the seconds of each phase."""

    def __init__(self, progress: ProgressCallback | None) -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress

    def report(self, phase: Phase, done: float) -> None:
        if self._progress is not None:
            self._progress(phase, min(done, 1.0))

    @contextmanager
    def phase(self, name: Phase) -> Iterator[None]:
        self.report(name, STARTS[name])
        start = time.perf_counter()
        yield
        self.seconds[f"seconds_{name}"] = time.perf_counter() - start

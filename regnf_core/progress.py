"""Progress reports and the seconds of each phase, the same for every preset."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from regnf_core.document import Phase, ProgressCallback, RegistrationResult

STARTS: dict[Phase, float] = {
    "sampling": 0.0,
    "initializing": 0.15,
    "optimizing": 0.2,
    "verifying": 0.95,
    "exporting": 0.98,
}
"""The overall share done when each phase begins."""


class Run:
    """Progress reports and the seconds of each phase."""

    def __init__(self, progress: ProgressCallback | None) -> None:
        self.seconds: dict[str, float] = {}
        self._done = 0.0
        self._progress = progress

    def report(self, phase: Phase, done: float) -> None:
        """Report a phase and the overall share done (0..1). The share never falls: a second attempt repeats earlier
        phases."""
        self._done = max(self._done, min(done, 1.0))
        if self._progress is not None:
            self._progress(phase, self._done)

    def optimized(self, share: float) -> None:
        """Report the share 0..1 of the optimization that is done."""
        self.report("optimizing", STARTS["optimizing"] + (STARTS["verifying"] - STARTS["optimizing"]) * share)

    def finish(self, result: RegistrationResult) -> RegistrationResult:
        """The result with the seconds of all phases among its metrics."""
        self.report("exporting", 1.0)
        result.metrics.update(self.seconds)
        return result

    @contextmanager
    def phase(self, name: Phase) -> Iterator[None]:
        self.report(name, STARTS[name])
        start = time.perf_counter()
        yield
        key = f"seconds_{name}"
        self.seconds[key] = self.seconds.get(key, 0.0) + time.perf_counter() - start

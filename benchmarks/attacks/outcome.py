"""What a run of attacks came to."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

_MOST_FAULTS = 200


@dataclass
class Outcome:
    """inputs: how many were sent · ends: how often each answer came · faults: what should not have happened."""

    inputs: int = 0
    kills: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    faults_in_all: int = 0
    slowest_s: float = 0.0
    peak_bytes: int = 0

    def fault(self, text: str) -> None:
        """Count one, and keep what it was unless there are too many."""
        self.faults_in_all += 1
        if len(self.faults) < _MOST_FAULTS:
            self.faults.append(text)

    def lines(self) -> list[str]:
        """A table for people."""
        said = "No fault." if not self.faults else f"{max(self.faults_in_all, len(self.faults))} faults:"
        return [
            f"{self.inputs} inputs, {self.kills} kills. {said}",
            *[f"- {fault}" for fault in self.faults[:50]],
            "",
            "| end | count |",
            "|---|---|",
            *[f"| {name} | {count} |" for name, count in sorted(self.ends.items())],
            "",
            f"Slowest answer of `/healthz`: {self.slowest_s * 1000:.0f} ms. Peak memory of the API: "
            f"{self.peak_bytes / 1e6:.0f} MB.",
        ]

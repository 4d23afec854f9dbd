"""Inputs that a fuzzer has kept: one file each, named by its stage and by how it ended.

    python -m tests.core.importing.fuzzing.corpus SOURCE TARGET

copies the smallest input of every outcome of every stage, as far as there is room, for tests to replay.
"""

from __future__ import annotations

import hashlib
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

_MAX_BYTES = 1 << 16
_MAX_FILES = 400
"""Of a stage."""
_MAX_DISTILLED = 900_000
"""Bytes that tests may carry along."""


@dataclass(frozen=True)
class Kept:
    """One input: what stage it is for, how it ended, and its bytes."""

    stage: str
    outcome: str
    path: Path

    @property
    def data(self) -> bytes:
        """The input."""
        return self.path.read_bytes()


class Corpus:
    """A folder of inputs worth building upon: those with a new outcome, a new step, a smaller way to an outcome."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._smallest: dict[tuple[str, str], int] = {}
        self._count: dict[str, int] = {}
        for kept in self.all():
            self._note(kept.stage, kept.outcome, kept.path.stat().st_size)

    def all(self) -> list[Kept]:
        """Everything in the folder, by name."""
        files = sorted(path for path in self.folder.glob("*/*") if path.is_file())
        return [Kept(path.parent.name, path.name.partition("-")[0], path) for path in files]

    def of(self, stage: str) -> list[bytes]:
        """The inputs of one stage."""
        return [kept.data for kept in self.all() if kept.stage == stage]

    def offer(self, stage: str, outcome: str, data: bytes, new_step: bool = False) -> bool:
        """Keep the input if it is worth it; returns whether its outcome is new."""
        smallest = self._smallest.get((stage, outcome))
        room = self._count.get(stage, 0) < _MAX_FILES
        if len(data) <= _MAX_BYTES and (smallest is None or len(data) < smallest or (new_step and room)):
            place = self.folder / stage
            place.mkdir(exist_ok=True)
            (place / f"{outcome}-{hashlib.sha256(data).hexdigest()[:12]}").write_bytes(data)
            self._note(stage, outcome, len(data))
        return smallest is None

    def _note(self, stage: str, outcome: str, size: int) -> None:
        key = (stage, outcome)
        self._smallest[key] = min(size, self._smallest.get(key, size))
        self._count[stage] = self._count.get(stage, 0) + 1


def distill(source: Path, target: Path) -> int:
    """Copy the smallest input of every outcome of every stage, as far as there is room. Returns how many."""
    smallest: dict[tuple[str, str], Kept] = {}
    for kept in Corpus(source).all():
        key = (kept.stage, kept.outcome)
        if key not in smallest or kept.path.stat().st_size < smallest[key].path.stat().st_size:
            smallest[key] = kept
    copied = total = 0
    for kept in sorted(smallest.values(), key=lambda kept: kept.path.stat().st_size):
        total += kept.path.stat().st_size
        if total > _MAX_DISTILLED:
            break
        copied += 1
        place = target / kept.stage
        place.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(kept.path, place / kept.path.name)
    return copied


if __name__ == "__main__":
    distill(Path(sys.argv[1]), Path(sys.argv[2]))

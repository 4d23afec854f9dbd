"""Wall clocks that a test may step, for whole processes: see clock_shim.c."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

_SHIM = Path(__file__).with_name("clock_shim.c")


@dataclass(frozen=True)
class SteppedClock:
    """One clock; every process that is started with ``environment`` reads it."""

    library: Path
    file: Path

    @property
    def environment(self) -> dict[str, str]:
        return {"LD_PRELOAD": str(self.library), "REGNF_TEST_CLOCK": str(self.file)}

    def step(self, seconds: int) -> None:
        """Set the clock that far from the true time, at once."""
        with self.file.open("r+b") as file:
            file.write(struct.pack("q", seconds))


def stepped_clock(folder: Path, name: str) -> SteppedClock:
    """A clock that is right so far. Skips the test, visibly, where it cannot be made."""
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("no C compiler, or no Linux: clocks cannot be stepped here")
    library = folder / "clock_shim.so"
    if not library.exists():
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(_SHIM)], check=True, timeout=60)
    made = SteppedClock(library, folder / f"{name}.clock")
    made.file.write_bytes(struct.pack("q", 0))
    return made

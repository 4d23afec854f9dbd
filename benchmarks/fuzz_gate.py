"""Fuzz the import gate: many damaged and invented files, each stage in one process, some through the whole gate.

    python -m benchmarks.fuzz_gate --cases 200000 --seed 1 [--stages NAME ...] [--output FILE] [--keep FOLDER]
        [--corpus FOLDER]

A case fails if a stage raises anything but FieldFormatError, takes five seconds of processor time, needs more
than 2 GiB of address space, leaves a file, or brings about an import, a program, a socket or the opening of a file;
through the whole gate also if the process crashes or is stopped. Failing cases are written to the folder of --keep.
Cases that reach a new outcome or take a new step are kept in that of --corpus, and the next run builds upon them.
Ends with status 1 if there are any failures.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import platform
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

from regnf_core.errors import FieldFormatError
from regnf_core.importing.gate.gate import FIELD_NAME, ImportLimits, import_field
from tests.core.importing.fuzzing.cases import STAGES
from tests.core.importing.fuzzing.seeds import make_seeds
from tests.core.importing.fuzzing.worker import CASE_S, ENVIRONMENT, MEMORY_BYTES

_ANSWER_S = 3600.0
"""For a chunk of cases, each of which has a limit of its own: a machine may have other things to do."""
_GATE = "whole gate"
_FAULTS = ("IMPORT_CRASHED", "IMPORT_TIMEOUT", "IMPORT_OUT_OF_MEMORY", "IMPORT_OUTPUT_TOO_LARGE")
"""Reasons that no small file should come to."""


class Worker:
    """A fuzzing process that is replaced when it ends before its answer."""

    def __init__(self, folder: Path, seed: str, corpus: Path, stages: list[str]) -> None:
        self._folder = folder
        places = (str(folder / "seeds"), str(folder), seed, str(corpus))
        command = [sys.executable, "-m", "tests.core.importing.fuzzing.worker", *places, *stages]
        environment = os.environ | ENVIRONMENT
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def run(self, first: int, count: int) -> dict[str, Any] | None:
        """The chunk's results, None if the process did not live to tell them."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("the worker was started without pipes")
        stdin.write(f"{first} {count}\n")
        stdin.flush()
        line = stdout.readline() if select.select([stdout], [], [], _ANSWER_S)[0] else ""
        if not line:
            return None
        results: dict[str, Any] = json.loads(line)
        return results

    def last_case(self) -> tuple[str, bytes]:
        """The case under way when the process ended, and its stage."""
        stage, _, data = (self._folder / "case").read_bytes().partition(b"\n")
        return stage.decode(), data

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()


@dataclass
class Tally:
    """What all chunks have come to."""

    outcomes: dict[str, Counter[str]] = field(default_factory=lambda: {s: Counter() for s in (*STAGES, _GATE)})
    failures: list[tuple[str, str]] = field(default_factory=list)
    slowest: tuple[float, str] = (0.0, "")
    slowest_gate: float = 0.0
    lines: int = 0
    finds: int = 0
    peak_bytes: int = 0
    keep: Path | None = None

    def add(self, results: dict[str, Any]) -> None:
        for key, count in results["outcomes"].items():
            stage, _, reason = key.partition(" ")
            self.outcomes[stage][reason] += count
        for failure in results["failures"]:
            self.fail(failure["at"], failure["fault"], base64.b64decode(failure["case"]))
        self.slowest = max(self.slowest, (results["slowest"][0], results["slowest"][1]))
        self.lines, self.finds = max(self.lines, results["lines"]), max(self.finds, results["finds"])
        self.peak_bytes = max(self.peak_bytes, results["peak_bytes"])

    def fail(self, where: str, fault: str, data: bytes) -> None:
        self.failures.append((where, fault))
        print(f"FAILED {where}: {fault}", file=sys.stderr)
        if self.keep is not None:
            self.keep.mkdir(parents=True, exist_ok=True)
            (self.keep / f"{len(self.failures)}-{where.replace(' ', '-')}").write_bytes(data)


def through_the_gate(tally: Tally, folder: Path, data: bytes, where: str) -> None:
    """One file through ``import_field``, its process and all."""
    upload, out = folder / "upload", folder / "fields"
    upload.write_bytes(data)
    begun = time.perf_counter()
    try:
        import_field(upload, out, None, ImportLimits(wall_s=60))
        outcome, expected = "taken", [FIELD_NAME]
    except FieldFormatError as error:
        outcome, expected = error.reason, []
    except Exception as error:  # noqa: BLE001 (whatever it is, it is the find)
        outcome, expected = type(error).__name__, []
        tally.fail(where, f"{error!r:.300}", data)
    tally.slowest_gate = max(tally.slowest_gate, time.perf_counter() - begun)
    tally.outcomes[_GATE][outcome] += 1
    if outcome in _FAULTS:
        tally.fail(where, outcome, data)
    found = [path.name for path in out.iterdir()]
    if found != expected:
        tally.fail(where, f"files left: {found}", data)
    for path in out.iterdir():
        path.unlink()


def fuzz(folder: Path, arguments: argparse.Namespace) -> Tally:
    """All chunks, one after the other."""
    tally = Tally(keep=arguments.keep)
    make_seeds(folder).save(folder / "seeds")
    first, part = 0, 0
    while first < arguments.cases:
        part += 1
        corpus = arguments.corpus or folder / "corpus"
        with Worker(folder, f"{arguments.seed}.{part}", corpus, arguments.stages) as worker:
            while first < arguments.cases:
                count = min(arguments.chunk, arguments.cases - first)
                results = worker.run(first, count)
                first += count
                if results is None:
                    stage, data = worker.last_case()
                    tally.fail(f"{stage} before {first}", "the process ended or did not answer", data)
                    break
                tally.add(results)
                for stage, sample in results["samples"]:
                    through_the_gate(tally, folder, base64.b64decode(sample), f"{_GATE}, {stage} before {first}")
                print(f"{first} cases, {len(tally.failures)} failures, {tally.lines} lines", file=sys.stderr)
    return tally


def table(tally: Tally) -> str:
    """Reasons by stage."""
    columns = [stage for stage in tally.outcomes if tally.outcomes[stage]]
    reasons = sorted({reason for stage in columns for reason in tally.outcomes[stage]} - {"taken"})
    lines = [f"| outcome | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    for reason in ("taken", *reasons):
        counts = (str(tally.outcomes[stage][reason] or "") for stage in columns)
        lines.append(f"| {reason} | {' | '.join(counts)} |")
    totals = (str(tally.outcomes[stage].total()) for stage in columns)
    return "\n".join([*lines, f"| all | {' | '.join(totals)} |"])


def report(tally: Tally, arguments: argparse.Namespace, seconds: float) -> str:
    """The text of the results' page."""
    command = f"python -m benchmarks.fuzz_gate --cases {arguments.cases} --seed {arguments.seed}"
    if arguments.stages != list(STAGES):
        command += f" --stages {' '.join(arguments.stages)}"
    failures = [f"- {where}: {fault}" for where, fault in tally.failures] or ["No case failed."]
    slowest, where = tally.slowest
    return "\n".join(
        [
            f"Command: `{command}`, {datetime.now(UTC):%Y-%m-%d}, {platform.system()} {platform.machine()}, "
            f"Python {platform.python_version()}, {seconds / 60:.0f} minutes on one core",
            "",
            *failures,
            "",
            table(tally),
            "",
            f"Slowest case in its stage: {slowest:.2f} s of processor time ({where}), of {CASE_S:.0f} s allowed; "
            f"through the whole gate: {tally.slowest_gate:.1f} s. Largest resident size of the process that runs the "
            f"stages: {tally.peak_bytes / 1e6:.0f} MB, of {MEMORY_BYTES / 1e6:.0f} MB of address space allowed.",
            f"Feedback: half of the cases are traced line by line; {tally.lines} lines of the gate's own modules were "
            f"reached, and {tally.finds} cases kept because they took a new step, for later ones to build upon.",
        ]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES), help="these alone")
    parser.add_argument("--chunk", type=int, default=1000)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--corpus", type=Path, help="where cases worth building upon are kept from run to run")
    parser.add_argument("--keep", type=Path, help="where failing cases are written")
    arguments = parser.parse_args()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="regnf-fuzz-") as folder:
        tally = fuzz(Path(folder), arguments)
    text = report(tally, arguments, time.monotonic() - begun)
    print(text)
    if arguments.output:
        arguments.output.write_text(f"# Fuzzing the import gate\n\n{text}\n")
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())

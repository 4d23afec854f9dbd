"""The process that runs a fuzzer's cases: little memory, a time limit each, every import and file noticed.

    python -m tests.core.importing.fuzzing.worker SEEDS FOLDER SEED CORPUS STAGE...

Reads lines "FIRST COUNT" and answers each with one line of JSON. The case under way lies in FOLDER/case, for whoever
has to find out why this process ended. Cases are built upon those in the folder CORPUS, which grows.
"""

from __future__ import annotations

import base64
import importlib
import json
import os
import pkgutil
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from random import Random
from types import CodeType, FrameType
from typing import Any

from regnf_core import importing
from regnf_core.importing import families
from tests.core.importing.fuzzing.cases import make_case
from tests.core.importing.fuzzing.corpus import Corpus
from tests.core.importing.fuzzing.seeds import load_seeds
from tests.core.importing.fuzzing.stages import PARTS, Watch, run_stage

MEMORY_BYTES = 2 << 30
CASE_S = 5.0
_TRACED_S = 20.0
"""The same with every line traced, which makes Python several times slower."""
ENVIRONMENT = {"MALLOC_ARENA_MAX": "1"}
"""Variables that the process needs. Each thread's arena would take 64 MiB of its address space, used or not."""
_MAX_FINDS = 400
_TRACED_SHARE = 0.5


class TimeLimitError(BaseException):
    """A case took too much processor time. No stage may catch it."""


def _late(*_: object) -> None:
    raise TimeLimitError


class Coverage:
    """Collects steps (from line, to line) of the gate's own modules while a case runs: the feedback of the fuzzer.

    The families of checkpoints are left out: their searches would take most of the time and lead nowhere new.
    """

    def __init__(self) -> None:
        self.steps: set[tuple[CodeType, int, int]] = set()
        self._ours, self._families = str(next(iter(importing.__path__))), str(next(iter(families.__path__)))

    @contextmanager
    def over(self) -> Iterator[None]:
        """Trace what runs inside."""
        sys.settrace(self._enter)
        try:
            yield
        finally:
            sys.settrace(None)

    def _enter(self, frame: FrameType, *_: object) -> Any:
        code, before = frame.f_code, 0
        if not code.co_filename.startswith(self._ours) or code.co_filename.startswith(self._families):
            return None

        def step(frame: FrameType, event: str, _: Any) -> Any:
            nonlocal before
            if event == "line":
                self.steps.add((code, before, frame.f_lineno))
                before = frame.f_lineno
            return step

        return step


class Fuzzer:
    """Makes cases and runs them. A case's index and the seed decide it, together with what was found before."""

    def __init__(self, seeds: Path, folder: Path, seed: str, corpus: Path, stages: list[str]) -> None:
        self.seeds, self.stages = load_seeds(seeds), stages
        self.folder, self.seed = folder, seed
        self.scratch = folder / "scratch"
        self.scratch.mkdir(exist_ok=True)
        self.case = (folder / "case").open("w+b", buffering=0)
        self.coverage, self.watch = Coverage(), Watch()
        self.corpus = Corpus(corpus)
        self.finds = {stage: self.corpus.of(stage) for stage in stages}
        self._warm_up()

    def _warm_up(self) -> None:
        """Have every module loaded that files may need: a family's own, and what sound files bring about."""
        for module in pkgutil.walk_packages(families.__path__, f"{families.__name__}."):
            importlib.import_module(module.name)
        for data in (self.seeds.archive, self.seeds.field_file, b"", *self.seeds.other_files.values()):
            for stage in (*PARTS, "file"):
                run_stage(stage, data, self.scratch)
        run_stage("pickle", self.seeds.pickles[1], self.scratch)

    def run_chunk(self, first: int, count: int) -> dict[str, Any]:
        outcomes: Counter[str] = Counter()
        failures: list[dict[str, Any]] = []
        samples: dict[bool, list[tuple[str, bytes]]] = {True: [], False: []}
        slowest, slowest_at = 0.0, ""
        for index in range(first, first + count):
            stage = self.stages[index % len(self.stages)]
            data = make_case(Random(f"{self.seed} {index}"), stage, self.seeds, self.finds[stage])
            begun = time.process_time()
            outcome, fault = self.run_case(stage, data, Random(index).random() < _TRACED_SHARE)
            seconds = time.process_time() - begun
            if seconds > slowest:
                slowest, slowest_at = seconds, f"{stage} {index}"
            outcomes[f"{stage} {outcome}"] += 1
            if fault:
                failures.append({"at": f"{stage} {index}", "fault": fault, "case": base64.b64encode(data).decode()})
            if stage != "pickle":
                samples[outcome == "taken"].append((stage, data))
        chosen = [Random(f"{self.seed} {first}").choice(of_a_kind) for of_a_kind in samples.values() if of_a_kind]
        return {
            "outcomes": outcomes,
            "failures": failures,
            "slowest": [slowest, slowest_at],
            "lines": len({(code.co_filename, line) for code, _, line in self.coverage.steps}),
            "finds": sum(map(len, self.finds.values())),
            "samples": [[stage, base64.b64encode(data).decode()] for stage, data in chosen],
            "peak_bytes": _peak_bytes(),
        }

    def run_case(self, stage: str, data: bytes, traced: bool) -> tuple[str, str]:
        """The outcome, and what was wrong about it ("" for nothing)."""
        self._write_down(stage, data)
        known, before = len(sys.modules), len(self.coverage.steps)
        try:
            signal.setitimer(signal.ITIMER_PROF, _TRACED_S if traced else CASE_S)
            with self.watch.over(stage), self.coverage.over() if traced else nullcontext():
                outcome = run_stage(stage, data, self.scratch)
            fault = ""
        except (TimeLimitError, Exception) as error:  # noqa: BLE001 (whatever it is, it is the find)
            outcome, fault = type(error).__name__, f"{error!r:.300}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        new_step = len(self.coverage.steps) > before
        new_outcome = self.corpus.offer(stage, outcome, data, new_step)
        if (new_step or new_outcome) and len(self.finds[stage]) < _MAX_FINDS:
            self.finds[stage].append(data)
        return outcome, fault or self._traces(known)

    def _write_down(self, stage: str, data: bytes) -> None:
        text = stage.encode() + b"\n" + data
        self.case.truncate(len(text))
        os.pwrite(self.case.fileno(), text, 0)

    def _traces(self, known: int) -> str:
        """What a case must not leave or do."""
        events, self.watch.events = self.watch.events, []
        left = [path.name for path in self.scratch.iterdir()]
        for name in left:
            (self.scratch / name).unlink()
        if events:
            return f"audit events: {events[:3]}"
        if left:
            return f"files left: {left[:3]}"
        return "" if len(sys.modules) == known else "a module was imported"


def _peak_bytes() -> int:
    """Largest resident size. getrusage would count what the parent held when it forked."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))


def main(arguments: list[str]) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _late)
    fuzzer = Fuzzer(Path(arguments[0]), Path(arguments[1]), arguments[2], Path(arguments[3]), arguments[4:])
    for line in sys.stdin:
        first, count = map(int, line.split())
        sys.stdout.write(json.dumps(fuzzer.run_chunk(first, count)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])

"""The measurements of the release, one after the other.

A step whose results are of the present engine is left out; what it has made is kept in the folder of --work, so that a
run which was interrupted goes on. Steps whose data is not given are named and left out.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.guard.__main__ import measured
from benchmarks.guard.fields import make_fields
from benchmarks.release import (
    BOP,
    KITCHEN,
    KNOWN_SCALE,
    OTHERS,
    PAIRS,
    PEERS,
    RESULTS,
    ROOT,
    TIME,
    TIMED,
    WORLDS,
    Run,
    read,
    revision_of,
)
from regnf_core.version import ENGINE_REVISION

_FIRST, _COUNT = 7100, 9
"""Worlds of the test split that nothing was trained or chosen on."""
_GATHERED: tuple[tuple[str, str, Sequence[str]], ...] = (
    ("rendered", "images", ("--wrong", "2")),
    ("tsdf", "images", ("--wrong", "2")),
    ("rendered", "nothing", ("--wrong", "1")),
    ("rendered", "recording", ("--kinds", "right", "--known-scale", str(KNOWN_SCALE))),
    ("tsdf", "recording", ("--kinds", "right", "--known-scale", str(KNOWN_SCALE))),
)
"""Which scenes are asked with which observation, and how many wrong questions about a case."""
_IDLE = 1.0
"""The load above which no time is measured."""
_LISTS = ("others", "moved", "same")
"""Of a row of `evidence`: what only the training needs."""


@dataclass(frozen=True)
class Step:
    """minutes: on two idle cores, about · needs: options that give its data."""

    minutes: str
    needs: Sequence[str]
    sources: Sequence[str]
    measure: Callable[[argparse.Namespace], None]

    @property
    def done(self) -> bool:
        exist = all((RESULTS / source).exists() for source in self.sources)
        return exist and all(revision_of(read(source)) == ENGINE_REVISION for source in self.sources)


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--meshes", type=Path, nargs=2, metavar=("OBJECTS", "FURNITURE"), help="folders of meshes")
    parser.add_argument("--rooms", type=Path, help="the layouts of the three main rooms")
    parser.add_argument("--real", type=Path, metavar="FRAMES", help="the recorded kitchen (docs/real-data.md)")
    parser.add_argument("--bop", type=Path, metavar="SETS", help="what benchmarks.bop.public made (docs/bop.md)")
    minutes = ", ".join(f"{name} {step.minutes}" for name, step in STEPS.items())
    parser.add_argument("--only", nargs="+", choices=STEPS, default=list(STEPS), help=f"minutes, about: {minutes}")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "release", help="for worlds, fields and maps")


def run(given: argparse.Namespace) -> None:
    given.work.mkdir(parents=True, exist_ok=True)
    for name in given.only:
        step = STEPS[name]
        absent = [option for option in step.needs if getattr(given, option) is None]
        if step.done:
            print(f"{name}: done, engine revision {ENGINE_REVISION}")
        elif absent:
            print(f"{name}: left out, it needs {' and '.join(f'--{option}' for option in absent)}")
        else:
            print(f"{name}: {step.minutes} minutes, about", flush=True)
            begun = time.monotonic()
            step.measure(given)
            print(f"{name}: {(time.monotonic() - begun) / 60:.1f} minutes", flush=True)


def _command(module: str, *arguments: object) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    command = [sys.executable, "-m", f"benchmarks.{module}", *map(str, arguments)]
    subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, check=True)


def _worlds(given: argparse.Namespace) -> None:
    folder = given.work / "worlds"
    split = ("--part", "test", "--workers", 2)
    for scene in ("rendered", "tsdf"):
        where = ("--meshes", *given.meshes, "--scene", scene, "--start", _FIRST, "--count", _COUNT)
        _command("worlds", "make", folder, *split, *where)
    found: list[Run] = []
    for scene, by, more in _GATHERED:
        file = given.work / f"{scene}-{by}-{ENGINE_REVISION}.jsonl"
        if not file.exists():
            part = file.with_suffix(".part")
            part.unlink(missing_ok=True)
            asked = ("--scene", scene, "--observed-by", by, *more, "--answers-alone", "--output", part)
            _command("worlds", "evidence", folder, *split, *asked)
            part.rename(file)
        found += [json.loads(line) for line in file.read_text().splitlines()]
    kept = ({key: value for key, value in row.items() if key not in _LISTS} for row in found)
    text = "".join(json.dumps(row) + "\n" for row in kept)
    (RESULTS / WORLDS).write_bytes(gzip.compress(text.encode(), mtime=0))
    _command(
        "worlds",
        "trust",
        RESULTS / WORLDS,
        "--output",
        (RESULTS / WORLDS).with_name("trust.md"),
        "--diagrams",
        given.work,
    )
    shutil.copy(given.work / "reliability-all.svg", ROOT / "docs" / "images" / "reliability.svg")


def _fields(given: argparse.Namespace) -> Path:
    folder: Path = given.work / "exact"
    _command("make_fields", given.meshes[1], given.rooms, folder, "--exact", 200, 120)
    return folder


def _exact(given: argparse.Namespace) -> None:
    _command("robust", _fields(given), "--only", "pairs", "wrong_objects", "--seeds", 2, "--output", RESULTS / "exact")


def _peers(given: argparse.Namespace) -> None:
    methods = ("robust", "ransac_icp_normalized", "ransac_icp_scaled", "splatreg_normalized")
    _command("peers", _fields(given), "--only", *methods, "--seeds", 1, "--output", RESULTS / "exact" / "peers.md")


def _real(given: argparse.Namespace) -> None:
    folder = given.work / "kitchen"
    cut = folder / "cut"
    if not cut.exists():
        for command in ("fuse", "cut"):
            _command("real", command, given.real, folder)
        cut.touch()
    runs = folder / f"runs-{ENGINE_REVISION}.json"
    _command("real", "register", given.real, folder, "--objects", "points", "grid", "--runs", runs.absolute())
    _write_runs(KITCHEN, json.loads(runs.read_text()))


def _bop(given: argparse.Namespace) -> None:
    for name in BOP:
        folder = given.work / "bop" / name
        _command("bop", given.bop / name, "--output", folder)
        (RESULTS / "bop").mkdir(exist_ok=True)
        shutil.copy(folder / "regnf.jsonl", RESULTS / "bop" / f"{name}.jsonl")


def _time(given: argparse.Namespace) -> None:
    if os.getloadavg()[0] > _IDLE:
        print("time: left out, the machine is busy: processor seconds would be up to twice as many")
        return
    folder = given.work / "timed"
    folder.mkdir(exist_ok=True)
    make_fields(folder)
    rounds = [measured(ROOT, folder, 5, tuple(TIMED)) for _ in range(3)]
    seconds = {name: round(statistics.median(one[name]["seconds"] for one in rounds), 4) for name in TIMED}
    facts = {"revision": ENGINE_REVISION, "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    _write_runs(TIME, [{**facts, "case": name, "seconds": taken} for name, taken in seconds.items()])


def _write_runs(source: str, runs: Sequence[Run]) -> None:
    lines = ",\n".join("  " + json.dumps(run) for run in runs)
    (RESULTS / source).write_text(f'{{\n "runs": [\n{lines}\n ]\n}}\n')


STEPS = {
    "time": Step("2", (), (TIME,), _time),  # the first one: the others leave a load behind
    "worlds": Step("40", ("meshes",), (WORLDS,), _worlds),
    "exact": Step("5", ("meshes", "rooms"), (PAIRS, OTHERS), _exact),
    "peers": Step("2", ("meshes", "rooms"), (PEERS,), _peers),
    "real": Step("20", ("real",), (KITCHEN,), _real),
    "bop": Step("3", ("bop",), [f"bop/{name}.jsonl" for name in BOP], _bop),
}

"""Simulated frames: register their objects, and print what was found.

    python -m benchmarks.frames run --meshes DIR [DIR ...] --part validation --count 300 --output rows.jsonl
    python -m benchmarks.frames report rows.jsonl [--output report.md]
    python -m benchmarks.frames evidence rows.jsonl --output evidence.jsonl.gz

The last writes what `python -m benchmarks.worlds train` reads: a row a pose. A seed is one object with its frames.
The part `test` is for reporting: choose nothing on it.
"""

from __future__ import annotations

import argparse
import gzip
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before torch loads

import torch  # noqa: E402

from benchmarks.frames.measuring import rows_of  # noqa: E402
from benchmarks.frames.tables import markdown  # noqa: E402
from benchmarks.random_worlds.models import PARTS  # noqa: E402


def main() -> None:
    arguments = _parser().parse_args()
    {"run": _run, "report": _report, "evidence": _evidence}[arguments.command](arguments)


def _run(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    with arguments.output.open("a") as file:
        for seed in range(arguments.first, arguments.first + arguments.count):
            for row in rows_of(tuple(arguments.meshes), arguments.part, seed, arguments.every_detection):
                file.write(json.dumps(row) + "\n")
                file.flush()


def _report(arguments: argparse.Namespace) -> None:
    text = markdown(_read(arguments.rows))
    sys.stdout.write(text)
    if arguments.output is not None:
        arguments.output.write_text(text)


def _evidence(arguments: argparse.Namespace) -> None:
    facts = ("world", "part", "object", "model", "detection", "sensor", "visible", "verdict", "probability")
    with gzip.open(arguments.output, "wt") as file:
        for number, row in enumerate(_read(arguments.rows)):
            told = {name: row[name] for name in facts if name in row} | {"question": row["asked"], "case": number}
            told |= {"scene": "frames", "length": "single" if row["views"] == 1 else "few"}
            told |= {"observed": True, "observed_by": "recording"}
            for pose in row["poses"]:
                answer = {"seen_difference": row["seen_difference"]} if pose["winner"] else {}
                file.write(json.dumps({**told, **answer, **pose}) + "\n")


def _read(paths: Sequence[Path]) -> list[dict[str, Any]]:
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frames", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run")
    run.add_argument("--meshes", type=Path, nargs="+", required=True)
    run.add_argument("--part", choices=PARTS, required=True)
    run.add_argument("--first", type=int, default=0, help="seed")
    run.add_argument("--count", type=int, default=100)
    run.add_argument("--every-detection", action="store_true", help="the right object by every kind of detection")
    run.add_argument("--output", type=Path, required=True)
    for name in ("report", "evidence"):
        other = commands.add_parser(name)
        other.add_argument("rows", type=Path, nargs="+")
        other.add_argument("--output", type=Path, required=name == "evidence")
    return parser


if __name__ == "__main__":
    sys.exit(main())

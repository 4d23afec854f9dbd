"""The engine on a GPU: the CPU's results beside the GPU's, times, memory.

    python -m benchmarks.gpu [FIELDS] [--device cuda] [--output FILE]

FIELDS: a folder that benchmarks.make_fields filled; without it, the demo's fields are taken. Takes ten minutes at most
(--seconds): what does not fit is left out and named. Exit status: 0 if all results are the CPU's, 1 if one is not, 3 if
there is no such device. `--device cpu` runs everything on the CPU.
"""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path

import torch

from benchmarks.gpu.deadline import Deadline
from benchmarks.gpu.pairs import demo_pairs, pairs_in
from benchmarks.gpu.report import Report
from benchmarks.gpu.sections import batches, correctness, evaluator, order, single

NO_DEVICE = 3


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the report, and say by the exit status whether all results are the CPU's."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", nargs="?", type=Path)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seeds", type=int, default=2, help="of each pair that is compared with the CPU")
    parser.add_argument("--repeats", type=int, default=20, help="of a single registration and of the evaluator")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8, 64])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--output", type=Path, help="a Markdown file for the report")
    asked = parser.parse_args(arguments)
    device = torch.device(asked.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("no CUDA device here: nothing was measured (`--device cpu` runs everything on the CPU)", file=sys.stderr)
        return NO_DEVICE
    deadline = Deadline(asked.seconds)
    pairs = demo_pairs() if asked.fields is None else pairs_in(asked.fields)
    report = Report(_heading(device, asked, arguments))
    report.add(evaluator(pairs, device, asked.repeats))
    report.add(single(pairs, device, asked.repeats, deadline))
    report.add(batches(pairs, device, asked.batches, deadline))
    report.add(order(pairs, device, deadline))
    report.add(correctness(pairs, device, asked.seeds, deadline))
    text = report.text()
    print(text)
    if asked.output is not None:
        asked.output.write_text(text + "\n", encoding="utf-8")
    return 0 if report.met else 1


def _heading(device: torch.device, asked: argparse.Namespace, arguments: list[str] | None) -> str:
    command = shlex.join(["python", "-m", "benchmarks.gpu", *(sys.argv[1:] if arguments is None else arguments)])
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.machine()} CPU"
    fields = "the demo's fields" if asked.fields is None else "the fields of the benchmark"
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    return "\n".join(
        [
            "# The engine on a GPU",
            "",
            f"Command: `{command}`, {datetime.now(UTC):%Y-%m-%d}, {name}, torch {torch.__version__}, "
            f"{os.cpu_count()} CPU cores, {torch.get_num_threads()} threads, load {load}; {fields}.",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())

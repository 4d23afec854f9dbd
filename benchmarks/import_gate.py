"""What a full-size checkpoint costs: its upload, the gate, and opening what the gate made of it.

    python -m benchmarks.import_gate [--runs 5] [--output benchmarks/results/import_gate.md]

The checkpoint is that of a real run with neus-facto (2^19 entries, 16 levels, 256 wide) with Adam's state: about
150 MB. Everything that is compared is measured in turn, once a run, on one disk; the table has the medians.
"""

from __future__ import annotations

import argparse
import hashlib
import http.client
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from os import cpu_count
from pathlib import Path
from statistics import median

from regnf_core.importing.gate.gate import FIELD_NAME, import_field
from regnf_core.importing.gate.report import ImportReport
from tests.contract.live import Live, live_service
from tests.core.importing.checkpoints import write_full_size_checkpoint

MB = 1e6
_OPEN = """
import sys, time
import torch
from regnf_core.fields.build import open_field
begun = time.perf_counter()
open_field(sys.argv[1])
print(time.perf_counter() - begun)
"""


@dataclass
class Runs:
    """Seconds of each run."""

    copy: list[float] = field(default_factory=list)
    upload: list[float] = field(default_factory=list)
    gate: list[float] = field(default_factory=list)
    gate_cpu: list[float] = field(default_factory=list)
    opening: list[float] = field(default_factory=list)
    peak: list[float] = field(default_factory=list)
    """Bytes, not seconds."""


def seconds_of_copy(source: Path, target: Path) -> float:
    """What cp and sha256sum take for the same file."""
    begun = time.perf_counter()
    subprocess.run(["cp", source, target], check=True)
    subprocess.run(["sha256sum", source], check=True, capture_output=True)
    taken = time.perf_counter() - begun
    target.unlink()
    return taken


def seconds_of_upload(live: Live, source: Path, sha256: str) -> float:
    """From the first byte to the answer that the file is stored under its SHA-256, on the disk."""
    connection = http.client.HTTPConnection("127.0.0.1", live.port, blocksize=1 << 20)
    begun = time.perf_counter()
    with source.open("rb") as file:
        connection.request("PUT", f"/fields/{sha256}", file, {"Content-Length": str(source.stat().st_size)})
        answer = connection.getresponse()
        answer.read()
    taken = time.perf_counter() - begun
    connection.request("DELETE", f"/fields/{sha256}")
    connection.close()
    if answer.status != 201:
        raise RuntimeError(f"the upload was answered with {answer.status}")
    return taken


def seconds_of_opening(path: Path) -> float:
    """``open_field`` in a fresh process that has loaded torch, as a worker's has."""
    command = [sys.executable, "-c", _OPEN, str(path)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def measure(folder: Path, count: int) -> tuple[Runs, ImportReport, int]:
    """All runs, the last import's report, and the upload's size in bytes."""
    runs, upload, fields = Runs(), folder / "full.ckpt", folder / "fields"
    write_full_size_checkpoint(upload)
    with upload.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    (folder / "state").mkdir()
    with live_service(folder / "state", with_worker=False, max_upload_bytes=1 << 30) as live:
        for _ in range(count):
            runs.copy.append(seconds_of_copy(upload, folder / "copy"))
            runs.upload.append(seconds_of_upload(live, upload, sha256))
            begun = time.perf_counter()
            report = import_field(upload, fields, picture=True)  # as a worker does it
            runs.gate.append(time.perf_counter() - begun)
            runs.gate_cpu.append(report.cpu_seconds)
            runs.peak.append(report.peak_memory_bytes)
            runs.opening.append(seconds_of_opening(fields / FIELD_NAME))
    return runs, report, upload.stat().st_size


def spread(values: list[float], unit: str, scale: float = 1.0, digits: int = 2) -> str:
    """Median, and the least and the most of the runs."""
    low, middle, high = (f"{scale * value:.{digits}f}" for value in (min(values), median(values), max(values)))
    return f"{middle} {unit} ({low} to {high})"


def table(runs: Runs, report: ImportReport, size: int) -> str:
    """What was measured beside what was asked for."""
    kept = 4 * report.parameters
    allowed = 3 * kept + 300 * MB
    speed, pace = ([size / MB / seconds for seconds in each] for each in (runs.upload, runs.copy))
    share = median(mine / other for mine, other in zip(speed, pace, strict=True))
    rows = [
        ("the gate, wall time", "10 s", spread(runs.gate, "s"), median(runs.gate) <= 10),
        ("the gate, processor time", "", spread(runs.gate_cpu, "s"), True),
        (
            "the gate's process, peak memory",
            f"{allowed / MB:.0f} MB: 3 x the kept tensors ({kept / MB:.0f} MB) + 300 MB",
            spread(runs.peak, "MB", 1 / MB, 0),
            max(runs.peak) <= allowed,
        ),
        (
            "the kept file",
            f"{0.4 * size / MB:.0f} MB: 40 % of the upload",
            f"{report.field_bytes / MB:.1f} MB: {100 * report.field_bytes / size:.0f} %",
            report.field_bytes <= 0.4 * size,
        ),
        ("cp and sha256sum of the upload", "", spread(pace, "MB/s", digits=0), True),
        ("its upload", "", spread(speed, "MB/s", digits=0), True),
        ("the upload's speed, of cp's and sha256sum's in the same run", "60 %", f"{100 * share:.0f} %", share >= 0.6),
        ("opening the kept field", "0.2 s", spread(runs.opening, "s", digits=3), median(runs.opening) <= 0.2),
    ]
    lines = ["| | bar | measured | |", "|---|---|---|---|"]
    lines += [
        f"| {what} | {bar} | {found} | {'' if not bar else 'met' if met else 'missed'} |"
        for what, bar, found, met in rows
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
        runs, report, size = measure(Path(folder), arguments.runs)
    text = (
        f"Command: `python -m benchmarks.import_gate --runs {arguments.runs}`, {datetime.now(UTC):%Y-%m-%d}, "
        f"{platform.system()} {platform.machine()}, {cpu_count()} cores, Python {platform.python_version()}\n\n"
        f"A checkpoint of {size / MB:.0f} MB with Adam's state; median of {arguments.runs} runs, in brackets the least "
        f"and the most.\n\n{table(runs, report, size)}\n\n"
        f"Isolation: {', '.join(name for name, granted in report.isolation.items() if granted)}.\n"
    )
    print(text)
    if arguments.output:
        arguments.output.write_text(f"# The import gate, full size\n\n{text}")


if __name__ == "__main__":
    main()

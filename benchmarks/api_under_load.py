"""How the API behaves while a full-size checkpoint is uploaded and imported and a registration runs.

    python -m benchmarks.api_under_load [--output benchmarks/results/api_under_load.md]

Starts `regnf serve` in a temporary folder, posts the demo's registration, polls its job 50 times a second, uploads a
neus-facto checkpoint of full size (2^19 entries, 16 levels, Adam's state: about 150 MB) meanwhile, and reports the
latency of the polls, the peak memory of the API process and whether it ever mapped torch.
"""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import httpx
import numpy as np

from benchmarks.api_process import api_process
from benchmarks.service_load.small_fields import submit
from regnf_cli.demo import running_service
from regnf_client import Client
from tests.core.importing.checkpoints import write_full_size_checkpoint

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"
POLL_EVERY_S = 0.02


@dataclass
class Polls:
    """Latencies of one phase, seconds, and the API's memory seen meanwhile, bytes."""

    latencies: list[float] = field(default_factory=list)
    peak_memory: int = 0
    failures: int = 0


def poll(address: str, job_id: str, api_pid: int, stop: threading.Event, polls: Polls) -> None:
    """GET the job at a fixed rate until told to stop."""
    status = Path(f"/proc/{api_pid}/status")
    with httpx.Client(base_url=address) as client:
        while not stop.is_set():
            begun = time.perf_counter()
            response = client.get(f"/jobs/{job_id}")
            polls.latencies.append(time.perf_counter() - begun)
            polls.failures += response.status_code != 200
            for line in status.read_text().splitlines():
                if line.startswith("VmHWM"):
                    polls.peak_memory = max(polls.peak_memory, int(line.split()[1]) * 1024)
            stop.wait(POLL_EVERY_S)


def row(name: str, polls: Polls) -> str:
    times = np.array(polls.latencies) * 1000
    p50, p99 = np.percentile(times, [50, 99])
    return f"| {name} | {len(times)} | {p50:.1f} | {p99:.1f} | {times.max():.1f} | {polls.failures} |"


@contextmanager
def polling(address: str, job_id: str, pid: int, polls: Polls) -> Iterator[None]:
    """Poll in the background while the block runs."""
    stop = threading.Event()
    thread = threading.Thread(target=poll, args=(address, job_id, pid, stop, polls))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def measure(folder: Path) -> str:
    checkpoint = folder / "full.ckpt"
    write_full_size_checkpoint(checkpoint)
    size = checkpoint.stat().st_size
    idle, job_only, uploading, importing = Polls(), Polls(), Polls(), Polls()
    with running_service(folder / "state") as address, Client(address) as service:
        pid = api_process(address)
        request = {
            "scene": service.upload(DATA / "mix-room.safetensors").sha256,
            "object": service.upload(DATA / "armchair.safetensors").sha256,
            "detection": json.loads((DATA / "detection.json").read_text()),
        }
        first = submit(service, {**request, "seed": 1})
        with polling(address, first, pid, job_only):
            service.wait(first)
        with polling(address, first, pid, idle):
            time.sleep(5)
        second = submit(service, {**request, "seed": 2})
        begun = time.perf_counter()
        with polling(address, second, pid, uploading):
            service.upload(checkpoint, wait=False)
        upload_s = time.perf_counter() - begun
        with polling(address, second, pid, importing):
            service.wait(second)
            service.upload(checkpoint)
        import_s = time.perf_counter() - begun - upload_s
        mapped = "libtorch" in Path(f"/proc/{pid}/maps").read_text()
    peak = max(polls.peak_memory for polls in (idle, job_only, uploading, importing))
    lines = [
        "| polls of GET /jobs/{id} while | count | p50 ms | p99 ms | max ms | failures |",
        "|---|---|---|---|---|---|",
        row("idle", idle),
        row("a registration runs", job_only),
        row(f"a registration runs and {size / 1e6:.0f} MB are uploaded", uploading),
        row("that registration goes on and the upload is imported", importing),
        "",
        f"Upload {upload_s:.1f} s ({size / 1e6 / upload_s:.0f} MB/s); job and import done {import_s:.1f} s after it. "
        f"API process: peak memory {peak / 1e6:.0f} MB, torch mapped: {'yes' if mapped else 'no'}.",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-") as folder:
        table = measure(Path(folder))
    text = (
        f"Command: `python -m benchmarks.api_under_load`, {datetime.now(UTC):%Y-%m-%d}, "
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}\n\n{table}\n"
    )
    print(text)
    if arguments.output:
        arguments.output.write_text(f"# The API under load\n\n{text}")


if __name__ == "__main__":
    main()

"""Property-based tests of the whole contract: schemathesis sends what openapi.yaml allows, and what it does not.

    python -m benchmarks.fuzz_contract [--examples 400] [--seed 1] [--output benchmarks/results/fuzz_contract.md]

Starts the API and a worker over a Redis of their own, uploads small fields, has one job of each end, and runs every
check of schemathesis in all its phases (examples, coverage, fuzzing, stateful) against them; what it adds stands in
fuzz_contract_hooks.py and fuzz_contract.toml. Ends with status 1 when a check fails, a traceback is logged or a process
ends.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.service_load.small_fields import EMPTY_BOX, SmallPair, submit, write_small_pair
from regnf_client import Client
from regnf_service.http.query import encode_token
from tests.contract.live import Live, eventually, live_service
from tests.processes import children_of

_ROOT = Path(__file__).resolve().parents[1]
_HERE = Path(__file__).resolve().parent
_ENDLESS = {"preset": "paper", "optimization": {"iterations": 10_000, "stop_residual": 0.0}}
SETTINGS: dict[str, object] = {
    "threads": 1,
    "max_queued_jobs": 1_000_000,
    "max_uploads_per_caller": 1000,
    "job_timeout_s": 86400,
    "lost_after_s": 86400,
}
"""Limits out of the way: a full queue is a refusal like another, but no fault to be found here."""


@dataclass(frozen=True)
class Outcome:
    """What a run came to. ``failures`` is what schemathesis tells of each, and what was found beside it."""

    requests: int
    failures: list[str]
    statuses: dict[str, int]
    """Of the requests that fit the contract: how many were accepted, met nothing, conflicted, were refused."""
    covered: dict[str, int]
    phases: dict[str, str]
    report: dict[str, Any] = field(repr=False)


def prepare(live: Live, folder: Path, spare_fields: int) -> dict[str, Any]:
    """Fields in every state, jobs of every end; what the hooks are told of them."""
    pair = write_small_pair(folder)
    with Client(live.address) as service:
        request = pair.upload(service)
        ended = submit(service, request)
        failed = submit(service, {**request, "detection": EMPTY_BOX})
        for job in (ended, failed):
            service.wait(job)
        artifacts = [one.name for one in service.result(ended).artifacts]
        for name in artifacts:  # those that follow the result, before their process is stopped with the others
            service.download(ended, name, folder / "artifact")
    with live.client() as client:
        kept = [request["scene"], request["object"]]
        rejected = client.post("/fields", content=_broken(pair)).json()["sha256"]
        client.get(f"/fields/{rejected}", params={"wait": 30})
        spare_files = _spare_files(folder, spare_fields)
        spare = [client.post("/fields", content=path.read_bytes()).json()["sha256"] for path in spare_files]
        running = [client.post("/register", json={**request, "options": _ENDLESS, "seed": n}).json() for n in range(20)]
        client.post(f"/jobs/{running[-1]['id']}/cancel")
        _halt(live, client, running[0]["id"])
        created = [client.get("/jobs", params={"limit": 2}).json(), client.get("/fields", params={"limit": 2}).json()]
    jobs = [job["id"] for job in running]
    return {
        "files": [str(path) for path in (*spare_files, pair.object)],
        "fields": {"ready": kept, "kept": [*kept, rejected], "spare": spare},
        "jobs": {"ended": [ended, failed], "kept": [ended, failed, jobs[0], jobs[-1]], "spare": jobs[1:]},
        "artifacts": artifacts,
        "detection": pair.detection,
        "page_tokens": [page["next_page_token"] for page in created] + [encode_token((time.time(), "z"))],
    }


def _halt(live: Live, client: httpx.Client, job_id: str) -> None:
    """Stop the process of the job that runs, so that it goes on running, and all others waiting, at no cost."""
    assert live.worker is not None
    eventually(lambda: client.get(f"/jobs/{job_id}").json()["status"] == "running", "a job that runs", 180.0)
    for child in children_of(live.worker.pid):
        os.kill(child, signal.SIGSTOP)


def _broken(pair: SmallPair) -> bytes:
    data = pair.object.read_bytes()
    return data[: len(data) // 2]


def _spare_files(folder: Path, count: int) -> list[Path]:
    """Balls as small grids, each with bytes of its own: of what can be uploaded, nothing is imported in less time."""
    axis = np.linspace(-1.0, 1.0, 17, dtype=np.float32)
    distance = np.sqrt(sum(np.square(part) for part in np.meshgrid(axis, axis, axis, indexing="ij")))
    paths = [folder / f"ball-{index}.npz" for index in range(count)]
    for index, path in enumerate(paths):
        np.savez(path, sdf=distance - np.float32(0.5 + 0.01 * index), bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    return paths


def run(live: Live, folder: Path, arguments: Sequence[str], spare_fields: int = 4) -> Outcome:
    """Prepare the service, with so many fields that may be deleted, and let schemathesis at it."""
    world, report = folder / "world.json", folder / "report.json"
    world.write_text(json.dumps(prepare(live, folder, spare_fields)), encoding="utf-8")
    command = [
        *(sys.executable, "-m", "schemathesis.cli", "--config-file", str(_HERE / "fuzz_contract.toml"), "run"),
        *(str(_ROOT / "openapi.yaml"), "--url", live.address, "--checks", "all", "--continue-on-failure"),
        *("--request-timeout", "5", "--report", "json", "--report-json-path", str(report), "--no-color"),
        *("--generation-database", "none", "--output-sanitize", "false", *arguments),
    ]
    environment = os.environ | {
        "SCHEMATHESIS_HOOKS": "benchmarks.fuzz_contract_hooks",
        "REGNF_FUZZ_WORLD": str(world),
        "PYTHONPATH": str(_ROOT),
    }
    told = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if not report.exists():
        raise RuntimeError(f"schemathesis wrote no report: {told.stdout[-2000:]}{told.stderr[-2000:]}")
    return _outcome(live, json.loads(report.read_text(encoding="utf-8")), told)


def _outcome(live: Live, report: dict[str, Any], told: subprocess.CompletedProcess[str]) -> Outcome:
    failures = [told.stdout] if told.returncode else []
    ended = [name for name, process in (("API", live.api), ("worker", live.worker)) if process and process.poll()]
    failures += [f"the {name} ended" for name in ended]
    before, traceback, after = live.log().partition("Traceback")
    if traceback:
        failures.append(f"a traceback in the log: {before[-500:]}{traceback}{after[:3000]}")
    statuses: dict[str, int] = {}
    covered = {}
    for operation, phases in report["valid_rates"].items():
        covered[operation] = sum(counts.get("accepted", 0) for counts in phases.values())
        for counts in phases.values():
            for name, count in counts.items():
                statuses[name] = statuses.get(name, 0) + count
    phases_told = {name: phase["status"] for name, phase in report["phases"].items()}
    return Outcome(report["test_cases"]["generated"], failures, statuses, covered, phases_told, report)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=400, help="fuzzed requests of each operation, at most")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="regnf-fuzz-") as name:
        folder = Path(name)
        (folder / "state").mkdir()
        begun = time.monotonic()
        with live_service(folder / "state", **SETTINGS) as live:
            outcome = run(live, folder, ["--max-examples", str(arguments.examples), "--seed", str(arguments.seed)])
    command = f"python -m benchmarks.fuzz_contract --examples {arguments.examples} --seed {arguments.seed}"
    text = _text(outcome, command, time.monotonic() - begun)
    sys.stdout.write(text + "\n")
    for failure in outcome.failures:
        sys.stdout.write(f"\n{failure}\n")
    if arguments.output:
        arguments.output.write_text(f"# Fuzzing the contract\n\n{text}\n")
    return 1 if outcome.failures else 0


def _text(outcome: Outcome, command: str, seconds: float) -> str:
    load = os.getloadavg()[0]
    rows = [f"| {operation} | {count} |" for operation, count in sorted(outcome.covered.items())]
    phases = ", ".join(f"{name} {status}" for name, status in outcome.phases.items())
    return "\n".join(
        [
            f"Command: `{command}`, {datetime.now(UTC):%Y-%m-%d}, {platform.system()} {platform.machine()}, "
            f"{os.cpu_count()} cores (load {load:.1f}), Python {platform.python_version()}, "
            f"schemathesis {version('schemathesis')}, {seconds / 60:.0f} minutes",
            "",
            f"{outcome.requests} requests, {len(outcome.failures)} failures, every check. Phases: {phases}.",
            f"Of those that keep to the contract: {json.dumps(outcome.statuses)}",
            "",
            "| operation | accepted with 2xx |",
            "|---|---|",
            *rows,
        ]
    )


if __name__ == "__main__":
    sys.exit(main())

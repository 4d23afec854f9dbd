"""The demo: a library chair laid onto the chair in a room, through the real service.

Starts `regnf serve` with its state in .demo/, uploads two fields that ship with the repository, posts a detection,
follows the job and prints the transform, its error against the truth and the address of the page. In a terminal the
service then stays up for you to look; otherwise it ends. Exit status 0 only if the errors stay within the bounds.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from regnf_cli.console import phase_progress
from regnf_cli.local_service import running_service
from regnf_cli.remote import RemoteService

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "examples" / "data"
STATE = ROOT / ".demo"
MAX_ROTATION_RAD = 0.03
MAX_TRANSLATION_SHARE = 0.03
MAX_SCALE_SHARE = 0.02
console = Console(highlight=False)


def main() -> int:
    started = time.monotonic()
    shutil.rmtree(STATE, ignore_errors=True)
    with running_service(STATE) as address:
        console.print(f"service      {address}  (state in {STATE.name}/, its log in {STATE.name}/serve.log)")
        job, result = run(address)
        good = show(result)
        console.print(f"page         [bold]{address}/jobs/{job['id']}/view[/]")
        console.print(f"total        {time.monotonic() - started:.1f} s")
        if good and sys.stdin.isatty():
            console.print("\nOpen the page; press Enter here to stop the service.")
            with contextlib.suppress(KeyboardInterrupt, EOFError):
                input()
        return 0 if good else 1


def run(address: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Upload, register, follow; returns the job and its result."""
    with RemoteService(address) as service, phase_progress() as bar:
        task = bar.add_task("uploading", total=1.0)

        def report(phase: str, share: float) -> None:
            bar.update(task, description=phase, completed=share)

        job = service.submit(
            {
                "scene": service.upload_field(DATA / "mix-room.safetensors", report),
                "object": service.upload_field(DATA / "armchair.safetensors", report),
                "detection": json.loads((DATA / "detection.json").read_text()),
                "ground_truth": {"T_object_scene": truth()["T_object_scene"]["matrix"]},
                "seed": 0,
            }
        )
        service.follow(job["id"], report)
        return job, service.result(job["id"])


def truth() -> dict[str, Any]:
    values: dict[str, Any] = json.loads((DATA / "truth.json").read_text())
    return values


def show(result: dict[str, Any]) -> bool:
    """Print the transform and its errors; whether they are within the demo's bounds."""
    console.print(f"verdict      {result['verdict']} ({result['verdict_reason']})")
    console.print(f"             {result['verdict_detail']}")
    console.print("T_object_scene, from the scene's coordinates to the library object's:")
    for row in result["T_object_scene"]["matrix"]:
        console.print("   " + " ".join(f"{value:10.6f}" for value in row))
    metrics = result["metrics"]
    errors = [
        ("rotation", metrics["rotation_error_rad"], MAX_ROTATION_RAD, "rad"),
        ("translation", 100 * metrics["translation_error_share"], 100 * MAX_TRANSLATION_SHARE, "% of the diameter"),
        ("scale", 100 * metrics["scale_error_share"], 100 * MAX_SCALE_SHARE, "%"),
    ]
    sigma = result["uncertainty"]
    console.print(
        f"sure to      {max(sigma['rotation_deg']):.2g} degrees, {sigma['scale_percent']:.2g} % in scale (1 sigma)"
    )
    console.print("error against the truth")
    for name, value, bound, unit in errors:
        color = "green" if value <= bound else "red"
        console.print(f"   {name:<12} [{color}]{value:.4f}[/] {unit} (at most {bound:g})")
    return result["verdict"] == "registered" and all(value <= bound for _, value, bound, _ in errors)


if __name__ == "__main__":
    sys.exit(main())

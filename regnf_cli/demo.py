"""``regnf demo``: registers a library armchair with the armchair in a room, through the real service.

Starts `regnf serve`, uploads two fields that ship with regnf, posts a detection, follows the job, and prints the
transform, its error against the known true transform and the address of the page.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from regnf_cli.guard import require
from regnf_cli.report import EXIT_NOT_REGISTERED, EXIT_UNAVAILABLE, fail, in_percent, out, reporting, show_pose, tell
from regnf_cli.serve import demo_folder

if TYPE_CHECKING:
    from regnf_client import Result

# A private service for scripts and notebooks: `regnf serve` on a free port, stopped at the end.

START_DEADLINE_S = 30
STOP_DEADLINE_S = 30


@contextmanager
def running_service(state_dir: Path, checkout: Path | None = None, **settings: object) -> Iterator[str]:
    """Start `regnf serve` with its state under ``state_dir``; yields its address.

    ``checkout`` may name another checkout, whose `.venv` is used. ``settings`` are those of the service by name; the
    REGNF_* of this process' environment are not passed on. Its log is ``state_dir``/serve.log.
    Raises RuntimeError when it does not listen within half a minute.
    """
    state_dir.mkdir(parents=True, exist_ok=True)
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("REGNF_", "PYTHONPATH"))}
    from regnf_state.settings import variables

    environment |= variables(**settings)
    python = sys.executable if checkout is None else str(checkout / ".venv" / "bin" / "python")
    command = [python, "-m", "regnf_cli.main", "serve", "--port", "0", "--state-dir", str(state_dir)]
    with (state_dir / "serve.log").open("w") as log:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment, cwd=checkout)
    try:
        yield _address(server)
    finally:
        server.send_signal(signal.SIGTERM)
        server.communicate(timeout=STOP_DEADLINE_S)


def _address(server: subprocess.Popen[str]) -> str:
    assert server.stdout is not None
    deadline = time.monotonic() + START_DEADLINE_S
    while time.monotonic() < deadline and server.poll() is None:
        if not select.select([server.stdout], [], [], 0.2)[0]:
            continue
        for word in server.stdout.readline().split():
            if word.startswith("http://"):
                return word.rstrip("/")
    server.kill()
    raise RuntimeError("the service did not start; see serve.log in its state directory")


MAX_ROTATION_RAD = 0.03
MAX_CENTER_SHARE = 0.03
MAX_SCALE_SHARE = 0.02


def demo(
    state_dir: Annotated[
        Path | None,
        typer.Option(
            help="State directory of the demo's service. It is emptied first and kept afterwards. "
            "[default: a temporary folder]"
        ),
    ] = None,
    keep_running: Annotated[
        bool | None,
        typer.Option(
            "--keep-running/--exit",
            help="Wait for Enter at the end, so that you can look at the page. [default: only in a terminal]",
        ),
    ] = None,
) -> None:
    """Run a complete registration on this machine: service, upload, job, result.

    The exit code is 0 if the result is registered and its errors are within the demo's bounds, and 1 otherwise.

    Example: **regnf demo**
    """
    require("service", "engine", "embedded")
    started = time.monotonic()
    waits = sys.stdin.isatty() if keep_running is None else keep_running
    with _state_folder(state_dir) as folder:
        try:
            with running_service(folder) as address:
                out.print(f"service      {address}  (log: {folder / 'serve.log'})")
                result = _register(address)
                good = _show(result)
                if waits:  # else the service ends now, and its page with it
                    out.print(f"page         [bold]{address}/jobs/{result.job}/view[/]", soft_wrap=True)
                out.print(f"total        {time.monotonic() - started:.1f} s")
                if waits:
                    out.print("\nOpen the page; press Enter here to stop the service.")
                    with contextlib.suppress(EOFError):
                        input()
        except RuntimeError as error:  # the service did not start
            tell((folder / "serve.log").read_text(errors="replace")[-2000:])
            raise typer.Exit(fail("SERVICE_NOT_STARTED", str(error), EXIT_UNAVAILABLE)) from error
    if not good:
        raise typer.Exit(EXIT_NOT_REGISTERED)


@contextmanager
def _state_folder(chosen: Path | None) -> Iterator[Path]:
    """An empty folder: the chosen one, which stays, or a temporary one, which goes."""
    if chosen is None:
        with tempfile.TemporaryDirectory(prefix="regnf-demo-", ignore_cleanup_errors=True) as folder:
            yield Path(folder)
        return
    if chosen.exists() and any(chosen.iterdir()) and not (chosen / "serve.log").exists():
        message = f"{chosen} has files that are not from a demo; give an empty folder, or the folder of an earlier demo"
        raise typer.Exit(fail("STATE_DIR_NOT_EMPTY", message))
    shutil.rmtree(chosen, ignore_errors=True)
    yield chosen


def _register(address: str) -> Result:
    data = demo_folder()
    truth = json.loads((data / "truth.json").read_text(encoding="utf-8"))["T_object_scene"]["matrix"]
    box = json.loads((data / "detection.json").read_text(encoding="utf-8"))
    room, chair = data / "mix-room.safetensors", data / "armchair.safetensors"
    from regnf_client import Client

    with Client(address) as client, reporting("uploading") as report:
        job = client.submit(room, chair, box, more={"ground_truth": {"T_object_scene": truth}}, progress=report)
        client.wait(job, report)
        return client.result(job)


def _show(found: Result) -> bool:
    """Print the transform and its errors; whether they are within the demo's bounds."""
    result = found.document
    out.print(f"verdict      {result['verdict']} ({result['verdict_reason']})")
    out.print(f"             {result['verdict_detail']}")
    out.print(f"probability  {in_percent(result)}")
    show_pose(result)
    metrics = result["metrics"]
    errors = [
        ("rotation", metrics["rotation_error_rad"], MAX_ROTATION_RAD, "rad"),
        ("center", 100 * metrics["center_error_share"], 100 * MAX_CENTER_SHARE, "% of the diameter"),
        ("scale", 100 * metrics["scale_error_share"], 100 * MAX_SCALE_SHARE, "%"),
    ]
    out.print("error against the true pose")
    for name, value, bound, unit in errors:
        color = "green" if value <= bound else "red"
        out.print(f"   {name:<12} [{color}]{value:.4f}[/] {unit} (at most {bound:g})")
    return result["verdict"] == "registered" and all(value <= bound for _, value, bound, _ in errors)

"""A private service for scripts and notebooks: `regnf serve` on a free port, stopped at the end."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    environment |= {f"REGNF_{name.upper()}": str(value) for name, value in settings.items()}
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
    raise RuntimeError("the service did not start; see serve.log in its state folder")

"""A service of one's own for scripts and notebooks: `regnf serve` on a free port, ended when done."""

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


@contextmanager
def running_service(state_dir: Path) -> Iterator[str]:
    """Start `regnf serve` with its state under ``state_dir``; yields its address.

    Its log is ``state_dir``/serve.log. Raises RuntimeError when it does not listen within half a minute.
    """
    state_dir.mkdir(parents=True, exist_ok=True)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("REGNF_")}
    command = [sys.executable, "-m", "regnf_cli.main", "serve", "--port", "0", "--state-dir", str(state_dir)]
    with (state_dir / "serve.log").open("w") as log:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment)
    try:
        yield _address(server)
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait(timeout=30)


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


def api_process(address: str) -> int:
    """The process that listens at the address, found through /proc (Linux)."""
    port = int(address.rsplit(":", 1)[1])
    inodes = {
        line.split()[9]
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
        if int(line.split()[1].split(":")[1], 16) == port and line.split()[3] == "0A"
    }
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            links = [os.readlink(entry) for entry in folder.iterdir()]
        except OSError:
            continue
        if any(f"socket:[{inode}]" in links for inode in inodes):
            return int(folder.parent.name)
    raise RuntimeError(f"no process listens at {address}")

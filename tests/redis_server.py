"""A private Redis for tests, on a Unix socket in a short-lived folder: Valkey, which ships, or Redis.

Valkey comes as a package. Redis is used where it is installed (`scripts/system-packages.sh test` installs it). What the
service asks of Redis is tested on both, by the fixture ``redis_url``. All other tests run on Valkey, or on the server
that ``REGNF_TEST_REDIS`` names: `REGNF_TEST_REDIS=redis pytest tests/worker tests/faults`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from regnf_cli.embedded_redis import answers, server_binary, server_command

_START_S = 20.0


def installed_servers() -> dict[str, str]:
    """The servers of this machine by name."""
    found = {"valkey": server_binary(), "redis": shutil.which("redis-server")}
    return {name: binary for name, binary in found.items() if binary}


def command_of(socket: Path, data: Path, server: str | None = None) -> list[str]:
    """What starts a server: the one named, or the one that the environment names."""
    binary = installed_servers()[server or os.environ.get("REGNF_TEST_REDIS", "valkey")]
    return [binary, *server_command(socket, data)[1:]]


@contextmanager
def private_redis(server: str | None = None) -> Iterator[str]:
    """Start a server without TCP; yields its address. Socket paths must be short, hence a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="rg-") as folder:
        socket = Path(folder) / "s"
        command = command_of(socket, Path(folder) / "data", server)
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            wait_for(f"unix://{socket}", process)
            yield f"unix://{socket}"
        finally:
            process.kill()
            process.wait()


def wait_for(url: str, process: subprocess.Popen[bytes]) -> None:
    """Returns once the server takes commands."""
    deadline = time.monotonic() + _START_S
    while not answers(url):
        assert process.poll() is None, "the Redis server has ended"
        assert time.monotonic() < deadline, "the Redis server does not answer"
        time.sleep(0.01)

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
    """The programs of this machine's servers by name.

    Debian's redis-tools, which starts no service of its own, has the server under the name of its checker.
    """
    found = {"valkey": server_binary(), "redis": shutil.which("redis-server") or shutil.which("redis-check-rdb")}
    return {name: program for name, program in found.items() if program}


def default_server() -> str:
    """The server that tests run on which are not about Redis itself."""
    return os.environ.get("REGNF_TEST_REDIS", "valkey")


def start_server(
    socket: Path, data: Path, server: str | None = None, environment: dict[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start the server that is named, or that the environment names; it takes commands once this returns."""
    program = installed_servers()[server or default_server()]
    command = ["redis-server", *server_command(socket, data)[1:]]
    process = subprocess.Popen(command, executable=program, stdout=subprocess.DEVNULL, env=environment)
    deadline = time.monotonic() + _START_S
    while not answers(f"unix://{socket}"):
        assert process.poll() is None, "the Redis server has ended"
        assert time.monotonic() < deadline, "the Redis server does not answer"
        time.sleep(0.01)
    return process


@contextmanager
def private_redis(server: str | None = None) -> Iterator[str]:
    """A server without TCP; yields its address. Socket paths must be short, hence a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="rg-") as folder:
        socket = Path(folder) / "s"
        process = start_server(socket, Path(folder) / "data", server)
        try:
            yield f"unix://{socket}"
        finally:
            process.kill()
            process.wait()

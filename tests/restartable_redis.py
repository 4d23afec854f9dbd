"""A Redis server, with the options of `regnf serve`, to be killed and started at will over the same history."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.redis_server import start_server


@dataclass
class RestartableRedis:
    """The server's socket is in ``folder``, what it keeps in ``data``."""

    folder: Path
    data: Path
    environment: dict[str, str] | None = None
    process: subprocess.Popen[bytes] | None = field(default=None)

    @property
    def url(self) -> str:
        return f"unix://{self.folder}/s"

    def start(self, server: str | None = None) -> None:
        self.process = start_server(self.folder / "s", self.data, server, self.environment)

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()


@contextmanager
def restartable_redis(
    data: Path | None = None, environment: dict[str, str] | None = None, server: str | None = None
) -> Iterator[RestartableRedis]:
    """A started server. Socket paths must be short, hence a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="rg-") as folder:
        made = RestartableRedis(Path(folder), data or Path(folder) / "data", environment)
        made.start(server)
        try:
            yield made
        finally:
            made.kill()

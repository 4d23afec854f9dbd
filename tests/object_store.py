"""An S3 server for tests: moto behind real HTTP on loopback, in a process of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from uuid import uuid4

import httpx
import pytest

ACCESS = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_REGION": "us-east-1"}
_START_DEADLINE_S = 60.0


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@dataclass
class ObjectServer:
    """The server; what it holds is gone when its process ends, and frozen while it is stopped."""

    port: int = field(default_factory=_free_port)
    process: subprocess.Popen[bytes] | None = None

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to be let in."""
        return ACCESS | {"AWS_ENDPOINT_URL": self.endpoint}

    def start(self) -> None:
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end = time.monotonic() + _START_DEADLINE_S
        while True:
            assert self.process.poll() is None, "moto ended"
            try:
                httpx.get(f"{self.endpoint}/moto-api/data.json", timeout=5.0)
                return
            except httpx.TransportError:
                assert time.monotonic() < end, "moto did not start in time"
                time.sleep(0.05)

    def new_bucket(self) -> str:
        name = f"bucket-{uuid4().hex[:12]}"
        httpx.put(f"{self.endpoint}/{name}", timeout=30.0).raise_for_status()
        return name

    def unfinished_uploads(self, bucket: str) -> int:
        """Multipart uploads that were begun and neither completed nor aborted."""
        return httpx.get(f"{self.endpoint}/{bucket}?uploads", timeout=30.0).text.count("<UploadId>")

    def freeze(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGCONT)

    def end(self) -> None:
        if self.process is not None:
            self.thaw()
            self.process.kill()
            self.process.wait()


@contextmanager
def object_server() -> Iterator[ObjectServer]:
    """A started server. Skips the test, visibly, where moto is not installed."""
    pytest.importorskip("moto", reason="moto is not installed: no S3 server to test against")
    server = ObjectServer()
    server.start()
    try:
        yield server
    finally:
        server.end()


@contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """This process' environment with a few variables more."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

"""Runs the command in this process, against pretended services too."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from regnf_cli.main import command

DATA = Path(__file__).resolve().parents[2] / "examples" / "data"


@dataclass(frozen=True)
class Outcome:
    """How a command ended, and what it said."""

    code: int
    stdout: str
    stderr: str


Run = Callable[..., Outcome]
Answer = tuple[int, str]
Answers = Callable[[str, str], Answer]
Serve = Callable[[Answers], str]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """``run(*arguments)``: the command `regnf` with these arguments. It asks a service again without a pause.

    Fails unless it ends with ``code``, where that is given.
    """
    monkeypatch.setattr("regnf_client.client.SyncDriver.sleep", lambda *_: None)
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")  # set by the command otherwise, for all tests that follow

    def call(*arguments: object, code: int | None = None) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["regnf", *(str(argument) for argument in arguments)])
        ended = command()
        captured = capfd.readouterr()
        assert code in (None, ended), captured.err
        return Outcome(ended, captured.out, captured.err)

    return call


@pytest.fixture
def demo() -> list[object]:
    """The arguments of a registration with the demo's fields."""
    fields = [DATA / "mix-room.safetensors", DATA / "armchair.safetensors"]
    return ["register", *fields, "--detection", DATA / "detection.json"]


UNIT = {"matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "scale": 1.0}
JOB = {"id": "j", "kind": "registration", "status": "successful"}
RESULT = {
    "verdict": "registered",
    "verdict_reason": "BECAUSE",
    "T_scene_object": UNIT,
    "T_object_scene": UNIT,
    "metrics": {"residual_rms": 0.5},
    "artifacts": [{"name": "result.json", "bytes": 7, "sha256": "0" * 64, "url": "/jobs/j/artifacts/result.json"}],
}


def field(path: str, **said: object) -> str:
    """The document of the field at a path, without a name."""
    return json.dumps({"sha256": path.removeprefix("/fields/"), "state": "ready", "bytes": 1, **said})


def service(job: Mapping[str, object] = JOB, **result: object) -> Answers:
    """A service that has every field and whose one job is done, with such a result."""

    def answers(method: str, path: str) -> Answer:
        if path.startswith("/fields/"):
            return 200, field(path)
        if path in ("/register", "/jobs/j", "/jobs/j/cancel"):
            return 200, json.dumps(job)
        return 200, json.dumps(RESULT | result) if path == "/jobs/j/result" else "content"

    return answers


def without_worker(stuck: str, checks: object = None) -> Answers:
    """A service whose fields (``stuck`` = fields) or jobs never end, for want of a worker or as ``checks`` say."""
    unready = {"reason": "NOT_READY", "checks": {"records": True, "worker": False} if checks is None else checks}

    def answers(method: str, path: str) -> Answer:
        if path == "/readyz":
            return 503, json.dumps(unready)
        if stuck == "fields" and path.startswith("/fields/"):
            return 200, field(path, state="validating")
        return service(JOB | {"status": "accepted"} if stuck == "jobs" else JOB)(method, path)

    return answers


@pytest.fixture
def serve() -> Iterator[Serve]:
    """``serve(answers)``: a server's address; ``answers(method, path)`` gives status and body."""
    servers: list[ThreadingHTTPServer] = []

    def start(answers: Answers) -> str:
        class Handler(BaseHTTPRequestHandler):
            def answer(self) -> None:
                self.rfile.read(int(self.headers.get("Content-Length", 0)))
                status, body = answers(self.command, self.path.partition("?")[0])
                self.send_response(status)
                self.send_header("Content-Length", str(len(body.encode())))
                self.end_headers()
                self.wfile.write(body.encode())

            do_GET = do_PUT = do_POST = do_PATCH = answer  # noqa: N815 (the names that http.server calls)

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        servers.append(ThreadingHTTPServer(("127.0.0.1", 0), Handler))
        threading.Thread(target=servers[-1].serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        return f"http://127.0.0.1:{servers[-1].server_address[1]}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()

"""A small HTTP server with the page and a pretended job API, for the browser tests and for looking at the page.

    python -m tests.ui.fixture_server        then open the printed addresses

The job's id chooses the story: done, running, queued, failed, dismissed, live, polled (live without an event stream),
ambiguous (with two more poses), judged (with a pose that was rejected), asked (the scene's file may be two functions),
locked (wants a token), numbers (made without pictures), labeled (the object's label is in its file), bare (a result
with little in it), roomy (with the scene round the detection), broken (damaged clouds), searched (the best of a
library), tipped (y is up), meshed (with display meshes) or rendered (a rendering).
"""

from __future__ import annotations

import json
import mimetypes
import re
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

from tests.ui.stories import MESHED, STORIES, STRIP, Stage, field_document, field_picture
from tests.ui.synthetic import object_mesh, scene_mesh, synthetic

WEB = Path(__file__).resolve().parents[2] / "service" / "regnf_service" / "web"
CONTENT_SECURITY_POLICY = "default-src 'self'"
TOKEN = "open-sesame"


class Handler(BaseHTTPRequestHandler):
    """GET and POST below /jobs/{story}, pictures below /fields, static files below /static."""

    protocol_version = "HTTP/1.1"
    stage: ClassVar[Stage]

    def do_GET(self) -> None:
        path = self.path.split("?")[0].removeprefix("/v1")
        if path.startswith("/static/"):
            return self._file(WEB / path.removeprefix("/static/"))
        if field := re.fullmatch(r"/fields/([0-9a-f]{64})(/mesh\.glb|/preview\.png|/candidates/1\.png)?", path):
            return self._field(field[1], field[2] or "")
        match = re.fullmatch(r"/jobs/(\w+)(/.*)?", path)
        if not match:
            return self._problem(404, "NOT_FOUND")
        story, rest = match[1], match[2] or ""
        if rest == "/view":
            return self._file(WEB / "view.html")
        if story not in STORIES:
            return self._problem(404, "JOB_NOT_FOUND")
        if story == "locked" and self._stranger():
            return self._problem(401, "UNAUTHENTICATED")
        return self._job(story, rest)

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path.endswith("/render"):
            return self._json(202, self.stage.rendering())
        if not self.path.endswith("/cancel"):
            return self._problem(404, "NOT_FOUND")
        self.stage.set(cancelled=True)
        return self._json(202, {})

    def _stranger(self) -> bool:
        return self.headers.get("Authorization") != f"Bearer {TOKEN}"

    def _field(self, sha256: str, rest: str) -> None:
        if rest == "":
            return self._json(200, field_document(sha256))
        if rest == "/mesh.glb":
            return self._bytes(200, scene_mesh() if sha256 == MESHED["scene"] else object_mesh(), "model/gltf-binary")
        if "/locked/" in self.headers.get("Referer", "") and self._stranger():
            return self._problem(401, "UNAUTHENTICATED")
        return self._bytes(200, field_picture(sha256), "image/png")

    def _job(self, story: str, rest: str) -> None:
        if rest == "":
            return self._json(200, self.stage.job(story))
        if rest == "/result":
            return self._json(200, self.stage.result(story))
        if rest == "/events":
            return self._problem(404, "NOT_FOUND") if story == "polled" else self._events(story)
        name = rest.removeprefix("/artifacts/")
        if (story, name) == ("rendered", STRIP):
            return self._bytes(200, field_picture("7c" * 32), "image/png")
        if name not in self.stage.data.artifacts or (story == "bare" and name == "trace.json"):
            return self._problem(404, "ARTIFACT_NOT_FOUND")
        data = self.stage.data.artifacts[name]
        return self._bytes(200, data[:50] if story == "broken" else data, "application/octet-stream")

    def _events(self, story: str) -> None:
        """One event a change, until the job has ended or the server closes."""
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        # a stream begins with the past: here an earlier attempt, which failed
        past = {"status": "failed", "phase": "loading", "progress": 0.1, "attempt": 0, "updated": 1_779_999_000.0}
        line = f"retry: 2000\n\nid: 0-1\nevent: status\ndata: {json.dumps(past)}\n\n"
        stage, told, number = self.stage, dict[str, Any](), 0
        while True:
            try:
                self.wfile.write(line.encode())
                self.wfile.flush()
            except OSError:
                return
            if stage.closing or told.get("status", "accepted") not in ("accepted", "running"):
                return
            before = told
            with stage.changed:
                stage.changed.wait_for(lambda known=before: stage.closing or stage.job(story) != known, timeout=0.5)
                told = stage.job(story)
            number += told != before
            data = {name: told[name] for name in ("status", "phase", "progress", "error")} | {"attempt": 1}
            event = f"id: {number}-0\nevent: progress\ndata: {json.dumps(data)}\n\n"
            line = event if told != before else ": still here\n\n"

    def _file(self, path: Path) -> None:
        if not path.is_file() or WEB not in path.resolve().parents:
            return self._problem(404, "NOT_FOUND")
        return self._bytes(200, path.read_bytes(), mimetypes.guess_type(path.name)[0] or "text/plain")

    def _problem(self, status: int, reason: str) -> None:
        self._json(status, {"title": reason.replace("_", " ").capitalize(), "status": status, "reason": reason})

    def _json(self, status: int, document: dict[str, Any]) -> None:
        self._bytes(status, json.dumps(document).encode(), "application/json")

    def _bytes(self, status: int, data: bytes, media_type: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Content-Security-Policy", CONTENT_SECURITY_POLICY)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Tests need no access log."""


class FixtureServer:
    """Serves on a free port of the loopback interface, in a thread of its own, while the context is open."""

    def __init__(self) -> None:
        self.stage = Stage(synthetic())
        handler = type("BoundHandler", (Handler,), {"stage": self.stage})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05})
        self.origin = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> FixtureServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stage.set(closing=True)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def view(self, story: str) -> str:
        return f"{self.origin}/jobs/{story}/view"


def main() -> None:
    with FixtureServer() as server:
        for story in STORIES:
            print(server.view(story))  # noqa: T201
        while True:
            time.sleep(2)
            server.stage.advance()


if __name__ == "__main__":
    main()

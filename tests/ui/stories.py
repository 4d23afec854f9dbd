"""A pretended job API for the page. A job's id is the story that its documents, its result and its fields tell."""

from __future__ import annotations

import io
import json
import math
import mimetypes
import re
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from PIL import Image

from regnf_core.errors import HINTS
from tests.ui.synthetic import (
    JOB_ID,
    Synthetic,
    object_mesh,
    rotation,
    scene_mesh,
    sim3_document,
    similarity,
    synthetic,
)

STEPS: tuple[dict[str, Any], ...] = (
    {"status": "accepted", "queue_position": 3},
    {"status": "running", "phase": "loading", "progress": 0.05},
    {"status": "running", "phase": "optimizing", "progress": 0.6},
    {"status": "successful", "phase": "exporting", "progress": 1.0},
)
FAILURE = {
    "type": "about:blank", "title": "No surface in the detection", "status": 422, "reason": "NO_SURFACE_IN_DETECTION",
    "hint": "Check the box.", "request_id": "req-7f3a",
    "detail": "12 surface points were found inside the box <b>chair</b>; 500 are needed.",
}  # fmt: skip
REJECTED = {"title": "Field rejected", "reason": "FIELD_REJECTED", "detail": "the field was rejected: LAYOUT_AMBIGUOUS"}
CANDIDATES = [
    {"name": "<i>smooth</i>", "description": {"hash": {"interpolation": "smoothstep"}}, "picture": "/1.png"},
    {"name": "linear", "description": {"hash": {"interpolation": "linear"}}, "picture": None},
]
STRIP = "before-after.png"
MESHED = {"scene": "a4" * 32, "object": "7d" * 32}
LABELS = {"a4": "hall.ply", "7d": "armchair.glb", "a3": "living <b>room</b>.ply", "7c": "chair.glb"}
IN_ITS_FILE = {"7e": "stool"}
"""A label that nobody gave at the upload: the field's file carries it."""
OPTIONS = "0f" * 32
"""A digest, and not one of a field."""
SIGMAS = [math.radians(0.4), math.radians(0.8), math.radians(0.2), 0.003, 0.001, 0.002, 0.005]
ORDERING = ["omega_x", "omega_y", "omega_z", "t_x", "t_y", "t_z", "log_s"]
WARNING = "TRUNCATION_ASSUMED: taken for <b>8</b> voxels"
DETAIL = "Several poses match the data equally well: this one and the alternatives."

_STILL = {"finished_at": None, "expires_at": None}
_WAITING = {"phase": None, "progress": 0.0}
JOBS: dict[str, dict[str, Any]] = {
    "running": {"status": "running", "phase": "optimizing", "progress": 0.62, **_STILL},
    "queued": {"status": "accepted", "queue_position": 4, **_WAITING, **_STILL},
    "failed": {"status": "failed", "phase": "sampling", "progress": 0.2, "error": FAILURE},
    "asked": {"status": "failed", "phase": "loading", "progress": 0.0, "error": FAILURE | REJECTED},
    "dismissed": {"status": "dismissed"},
    "rendered": {"id": "rendered", "kind": "render", "links": {"view": "/jobs/rendered/view"}},
}
"""What differs from the document of a registration that has ended well."""
INPUTS: dict[str, dict[str, Any]] = {
    "meshed": MESHED, "labeled": {"object": "7e" * 32}, "numbers": {"pictures": False},
}  # fmt: skip
"""What some stories' jobs were asked with."""


class Stage:
    """The state shared by all requests: how far the moving jobs are. Tests advance it; nothing moves on its own."""

    def __init__(self, data: Synthetic) -> None:
        self.data = data
        self.step = 0
        self.cancelled = False
        self.closing = False
        self.changed = threading.Condition()

    def set(self, **state: Any) -> None:
        with self.changed:
            self.__dict__.update(state)
            self.changed.notify_all()

    def advance(self) -> None:
        self.set(step=min(self.step + 1, len(STEPS) - 1))

    def job(self, story: str) -> dict[str, Any]:
        """The job document of a story, as the API would write it at this moment."""
        at = "2026-05-28T20:26:{}.000Z".format
        inputs = {"scene": "a3" * 32, "object": "7c" * 32, "seed": 7, "detection": self.data.detection}
        document = {
            "id": JOB_ID, "kind": "registration", "status": "successful", "phase": "exporting", "progress": 1.0,
            "attempts": 1, "updated_at": at(54), "created_at": at(40), "started_at": at(41), "finished_at": at(54),
            "expires_at": "2026-06-04T20:26:54.000Z", "error": None, "engine": {"version": "0.1.0", "device": "cpu"},
            "inputs": inputs | {"options_sha256": OPTIONS} | INPUTS.get(story, {}),
        }  # fmt: skip
        if story == "running" and self.cancelled:
            return document | JOBS["running"] | {"status": "dismissed"}
        return document | (_WAITING | STEPS[self.step] if story in ("live", "polled") else JOBS.get(story, {}))

    def rendering(self) -> dict[str, Any]:
        return self.job("rendered") | {"status": "accepted", **_WAITING}

    def result(self, story: str) -> dict[str, Any]:
        result = self.data.result
        if story == "rendered":
            return {"frames": 1, "size": [48, 32], "artifacts": [{"name": STRIP, "bytes": 1, "kind": "strip"}]}
        if story == "bare":
            return {name: result[name] for name in ("verdict", "verdict_reason", "T_object_scene", "metrics")}
        return result | (RESULTS[story](self.data) if story in RESULTS else {})


def _listed(data: Synthetic, name: str) -> dict[str, Any]:
    return {"artifacts": [*data.result["artifacts"], {"name": name}]}


def _ambiguous(data: Synthetic) -> dict[str, Any]:
    correlation = np.eye(7) + 0.3 * (np.eye(7, k=3) + np.eye(7, k=-3))

    def alternative(axis: list[float], angle: float, score: float, relation: str) -> dict[str, Any]:
        turned = similarity(1.0, rotation(axis, angle), [0, 0, 0]) @ data.T_object_scene
        return {"T_object_scene": sim3_document(turned), "score": score, "relation": relation}

    poses = [
        alternative([0, 0, 1], 3.0, 0.043, "172 degrees about z"),
        alternative([1, 0, 0], math.pi, 0.071, "180 degrees about x"),
    ]
    deviations = {"center_scene": SIGMAS[3:6], "rotation_deg": [0.4, 0.8, 0.2], "scale_percent": 100 * SIGMAS[6]}
    robust = {"rotations": 600, "inlier_distance": 0.015}
    return {
        "verdict": "ambiguous", "verdict_reason": "SEVERAL_POSES_AGREE", "verdict_detail": DETAIL,
        "verdict_hint": HINTS["SEVERAL_POSES_AGREE"], "alternatives": poses, "covariance_ordering": ORDERING,
        "covariance": (correlation * np.outer(SIGMAS, SIGMAS)).tolist(), "uncertainty": deviations,
        "fields": {
            "scene": {"family": "neus", "settings": None, "warnings": [WARNING]},
            "object": {"family": None, "settings": None, "warnings": []},
        },
        "symmetry": {"order": 2, "axis": [-0.001, 0.0, 1.0], "continuous": False},
        "metrics": data.result["metrics"] | {"score": 0.041},
        "options": {"preset": "robust", "sampling": {"views": 5}, "up_axis": None, "robust": robust},
    }  # fmt: skip


def _judged(data: Synthetic) -> dict[str, Any]:
    def judged(T: dict[str, Any], reason: str, probability: float, free: float) -> dict[str, Any]:
        metrics = {"probability": probability, "free_space_violations": free, "score": None}
        level = "default" if reason == "SURFACES_AGREE" else None
        return {"T_object_scene": T, "reason": reason, "detail": f"<b>{reason}</b>", "level": level, "metrics": metrics}

    tipped = sim3_document(similarity(1.0, rotation([1, 0, 0], 1.0), [0, 0, 0]) @ data.T_object_scene)
    poses = [judged(data.result["T_object_scene"], "SURFACES_AGREE", 0.97, 0.0)]
    return {"considered": [*poses, judged(tipped, "FREE_SPACE_VIOLATED", 0.02, 0.4)], **_listed(data, "considered.npz")}


def _searched(data: Synthetic) -> dict[str, Any]:
    def candidate(number: int, stage: str, score: float | None, verdict: str | None = None) -> dict[str, Any]:
        reason = "NO_SURFACE_IN_OBJECT" if stage == "unusable" else None
        return {"object": f"{number:02x}" * 32, "stage": stage, "score": score, "verdict": verdict,
                "verdict_reason": reason, "T_object_scene": None, "level": verdict and "strict",
                "probability": verdict and 0.99}  # fmt: skip

    apart = {"differs": 0.05, "seen": 0.037, "favor": 1.0, "distinguishable": True}
    ranking = [
        candidate(0xA0, "refined", 0.021, "registered"),
        candidate(0xA1, "refined", 0.34, "rejected") | {"probability": 0.3, "level": None, "difference": apart},
        *(candidate(0xB0 + k, "coarse", 0.4 + k / 100) for k in range(6)),
        *(candidate(0xC0 + k, "signature", 0.2) for k in range(3)),
        candidate(0xD0, "unusable", None),
    ]
    return {"object": ranking[0]["object"], "candidates": ranking}


RESULTS: dict[str, Callable[[Synthetic], dict[str, Any]]] = {
    "ambiguous": _ambiguous,
    "judged": _judged,
    "searched": _searched,
    "numbers": lambda _: {"artifacts": [{"name": "trace.json"}, {"name": "T_scene_object.npy"}]},
    "roomy": lambda data: _listed(data, "context_points.ply"),
    "tipped": lambda _: {"options": {"preset": "robust", "up_axis": "y"}},
}
"""What differs from the result of the story `done`."""
STORIES = ("done", *JOBS, *RESULTS, "live", "polled", "locked", "bare", "broken", "meshed", "labeled")


def field_document(sha256: str) -> dict[str, Any]:
    """The scene was asked about, the object is ready."""
    if sha256.startswith("a3"):
        error = {"reason": "LAYOUT_AMBIGUOUS", "candidates": CANDIDATES}
        return {"sha256": sha256, "state": "rejected", "label": LABELS["a3"], "error": error}
    links = {"mesh": f"/fields/{sha256}/mesh.glb"} if sha256 in MESHED.values() else {}
    said = {"label": LABELS.get(sha256[:2]), "report": {"label": IN_ITS_FILE.get(sha256[:2])}}
    return {"sha256": sha256, "state": "ready", **said, "links": links, "error": None}


def field_picture(sha256: str) -> bytes:
    """A PNG in a color of its own, by which a test tells it from another field's."""
    buffer = io.BytesIO()
    Image.new("RGB", (96, 32), f"#{sha256[:6]}").save(buffer, "PNG")
    return buffer.getvalue()


# a small HTTP server with the page and a pretended job API, for the browser tests and for looking at the page


WEB = Path(__file__).resolve().parents[2] / "service" / "regnf_service" / "web"
CONTENT_SECURITY_POLICY = "default-src 'self'"
TOKEN = "open-sesame"


class Handler(BaseHTTPRequestHandler):
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

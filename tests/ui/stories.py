"""The stories that the pretended job API tells: what the documents of its jobs, results and fields say."""

from __future__ import annotations

import io
import threading
from typing import Any

from PIL import Image

from tests.ui.synthetic import JOB_ID, Synthetic
from tests.ui.verdicts import ambiguous_result, judged_result, searched_result

STORIES = (
    "done",
    "judged",
    "ambiguous",
    "running",
    "queued",
    "failed",
    "dismissed",
    "asked",
    "live",
    "polled",
    "locked",
    "bare",
    "roomy",
    "broken",
    "searched",
    "tipped",
    "meshed",
    "numbers",
    "labeled",
    "rendered",
)
STEPS: tuple[dict[str, Any], ...] = (
    {"status": "accepted", "queue_position": 3},
    {"status": "running", "phase": "loading", "progress": 0.05},
    {"status": "running", "phase": "optimizing", "progress": 0.6},
    {"status": "successful", "phase": "exporting", "progress": 1.0},
)
FAILURE = {
    "type": "about:blank",
    "title": "No surface in the detection",
    "status": 422,
    "reason": "NO_SURFACE_IN_DETECTION",
    "hint": "Check the box.",
    "detail": "12 surface points were found inside the box <b>chair</b>; 500 are needed.",
    "request_id": "req-7f3a",
}

STRIP = "before-after.png"
MESHED = {"scene": "a4" * 32, "object": "7d" * 32}
LABELS = {"a4": "hall.ply", "7d": "armchair.glb", "a3": "living <b>room</b>.ply", "7c": "chair.glb"}
IN_ITS_FILE = {"7e": "stool"}
"""A label that nobody gave at the upload: the field's file carries it."""
OPTIONS = "0f" * 32
"""A digest, and not one of a field."""
INPUTS: dict[str, dict[str, Any]] = {
    "meshed": MESHED,
    "labeled": {"object": "7e" * 32},
    "numbers": {"pictures": False},
}
"""What some stories' jobs were asked with."""
RENDERING = {"links": {"view": "/jobs/rendered/view"}}
REJECTED = {"title": "Field rejected", "reason": "FIELD_REJECTED", "detail": "the field was rejected: LAYOUT_AMBIGUOUS"}
CANDIDATES = [
    {"name": "<i>smooth</i>", "description": {"hash": {"interpolation": "smoothstep"}}, "picture": "/1.png"},
    {"name": "linear", "description": {"hash": {"interpolation": "linear"}}, "picture": None},
]


class Stage:
    """The state shared by all requests: how far the moving jobs are. Tests advance it; nothing moves on its own."""

    def __init__(self, data: Synthetic) -> None:
        self.data = data
        self.step = 0
        self.cancelled = False
        self.closing = False
        self.changed = threading.Condition()

    def advance(self) -> None:
        with self.changed:
            self.step = min(self.step + 1, len(STEPS) - 1)
            self.changed.notify_all()

    def reset(self) -> None:
        with self.changed:
            self.step, self.cancelled = 0, False
            self.changed.notify_all()

    def close(self) -> None:
        with self.changed:
            self.closing = True
            self.changed.notify_all()

    def job(self, story: str) -> dict[str, Any]:
        """The job document of a story, as the API would write it at this moment."""
        document: dict[str, Any] = {
            "id": JOB_ID,
            "kind": "registration",
            "status": "successful",
            "phase": "exporting",
            "progress": 1.0,
            "attempts": 1,
            "updated_at": "2026-05-28T20:26:54.000Z",
            "created_at": "2026-05-28T20:26:40.000Z",
            "started_at": "2026-05-28T20:26:41.000Z",
            "finished_at": "2026-05-28T20:26:54.000Z",
            "expires_at": "2026-06-04T20:26:54.000Z",
            "inputs": {
                "scene": "a3" * 32,
                "object": "7c" * 32,
                "seed": 7,
                "detection": self.data.detection,
                "options_sha256": OPTIONS,
            },
            "engine": {"version": "0.1.0", "device": "cpu"},
            "error": None,
        }
        document["inputs"] |= INPUTS.get(story, {})
        return document | self._what_differs(story)

    def _what_differs(self, story: str) -> dict[str, Any]:
        """From the document of a job that has ended well."""
        still = {"finished_at": None, "expires_at": None}
        running = {"status": "running", "phase": "optimizing", "progress": 0.62, **still}
        moving = {"phase": None, "progress": 0.0} | STEPS[self.step]
        different: dict[str, dict[str, Any]] = {
            "running": running | ({"status": "dismissed"} if self.cancelled else {}),
            "queued": {"status": "accepted", "phase": None, "progress": 0.0, "queue_position": 4, **still},
            "failed": {"status": "failed", "phase": "sampling", "progress": 0.2, "error": FAILURE},
            "asked": {"status": "failed", "phase": "loading", "progress": 0.0, "error": FAILURE | REJECTED},
            "dismissed": {"status": "dismissed"},
            "rendered": {"id": story, "kind": "render", "inputs": {"scene": "a3" * 32}} | RENDERING,
            "live": moving,
            "polled": moving,
        }
        return different.get(story, {})

    def rendering(self) -> dict[str, Any]:
        """What the service answers when a rendering is asked for."""
        return self.job("rendered") | {"status": "accepted", "phase": None, "progress": 0.0}

    def result(self, story: str) -> dict[str, Any]:
        if story == "rendered":
            return {"frames": 1, "size": [48, 32], "artifacts": [{"name": STRIP, "bytes": 1, "kind": "strip"}]}
        if story == "bare":
            return {k: self.data.result[k] for k in ("verdict", "verdict_reason", "T_object_scene", "metrics")}
        if story == "numbers":
            return self.data.result | {"artifacts": [{"name": "trace.json"}, {"name": "T_scene_object.npy"}]}
        if story == "roomy":
            return self.data.result | {"artifacts": [*self.data.result["artifacts"], {"name": "context_points.ply"}]}
        if story == "searched":
            return searched_result(self.data)
        if story == "judged":
            return judged_result(self.data)
        if story == "tipped":
            return self.data.result | {"options": {"preset": "robust", "up_axis": "y"}}
        if story != "ambiguous":
            return self.data.result
        return ambiguous_result(self.data)


def field_document(sha256: str) -> dict[str, Any]:
    """The scene was asked about, the object is ready."""
    if not sha256.startswith("a3"):
        links = {"mesh": f"/fields/{sha256}/mesh.glb"} if sha256 in MESHED.values() else {}
        said = {"label": LABELS.get(sha256[:2]), "report": {"label": IN_ITS_FILE.get(sha256[:2])}}
        return {"sha256": sha256, "state": "ready", **said, "links": links, "error": None}
    return {
        "sha256": sha256,
        "state": "rejected",
        "label": LABELS["a3"],
        "error": {"reason": "LAYOUT_AMBIGUOUS", "candidates": CANDIDATES},
    }


def field_picture(sha256: str) -> bytes:
    """A PNG in a color of its own, by which a test tells it from another field's."""
    buffer = io.BytesIO()
    Image.new("RGB", (96, 32), f"#{sha256[:6]}").save(buffer, "PNG")
    return buffer.getvalue()

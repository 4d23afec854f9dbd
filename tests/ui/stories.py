"""The stories that the pretended job API tells: what the documents of its jobs, results and fields say."""

from __future__ import annotations

import io
import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

from regnf_core.errors import HINTS
from tests.ui.synthetic import JOB_ID, Synthetic, rotation, sim3_document, similarity

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
        """Change the state, and tell those who wait."""
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
        """What the service answers when a rendering is asked for."""
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
    """Two more poses, a covariance, a symmetry and options."""
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
    """One more pose that was judged, and rejected."""

    def judged(T: dict[str, Any], reason: str, probability: float, free: float) -> dict[str, Any]:
        metrics = {"probability": probability, "free_space_violations": free, "score": None}
        return {"T_object_scene": T, "reason": reason, "detail": f"<b>{reason}</b>", "metrics": metrics}

    tipped = sim3_document(similarity(1.0, rotation([1, 0, 0], 1.0), [0, 0, 0]) @ data.T_object_scene)
    poses = [judged(data.result["T_object_scene"], "SURFACES_AGREE", 0.97, 0.0)]
    return {"considered": [*poses, judged(tipped, "FREE_SPACE_VIOLATED", 0.02, 0.4)], **_listed(data, "considered.npz")}


def _searched(data: Synthetic) -> dict[str, Any]:
    """The best of a search among twelve objects."""

    def candidate(number: int, stage: str, score: float | None, verdict: str | None = None) -> dict[str, Any]:
        reason = "NO_SURFACE_IN_OBJECT" if stage == "unusable" else None
        return {"object": f"{number:02x}" * 32, "stage": stage, "score": score, "verdict": verdict,
                "verdict_reason": reason, "T_object_scene": None}  # fmt: skip

    ranking = [
        candidate(0xA0, "refined", 0.021, "registered"),
        candidate(0xA1, "refined", 0.34, "rejected"),
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

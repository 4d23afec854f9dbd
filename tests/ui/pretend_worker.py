"""A worker for the tests of the home page: it reads meshes at once, and finds every object where it is told to."""

from __future__ import annotations

import hashlib
import io
import json
import threading
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from regnf_core.viewing.field_views import mesh_file
from regnf_data.recordings.opening import open_recording
from regnf_data.recordings.stored import write_recording
from regnf_state.blobs.base import BlobStore
from regnf_state.ownership import sha256_of
from regnf_state.pieces import view_key
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.jobs import RecordStore
from regnf_state.room import original_key
from tests.frame_forms import png
from tests.ui.stories import field_picture

_LOOK_S = 0.1
OVERLAY = png(np.full((152, 200, 3), (30, 60, 200), np.uint8))
"""A picture with the caption of an overlay's height, and 100 rows more."""
_READ: dict[str, trimesh.Trimesh] = {}
"""What has been read, by SHA-256: most tests upload the same files."""


class PretendWorker:
    """Ends imports and jobs of ``caller`` while the context is open. pose: T_scene_object, 4x4, of every result."""

    def __init__(self, records: RecordStore, blobs: BlobStore, caller: str, pose: list[list[float]]) -> None:
        self._records, self._blobs, self._caller, self._pose = records, blobs, caller, pose
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> PretendWorker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._stop.wait(_LOOK_S):
            for field in self._records.list_fields(None, 100, None, self._caller).records:
                if field.state == "validating":
                    (self._import_recording if field.is_recording else self._import)(field)
                elif field.views == "pending":
                    self._draw(field)
            for job in self._records.list_jobs(None, 100, None, self._caller).records:
                if job.status == "accepted":
                    self._finish(job)

    def _import(self, field: FieldRecord) -> None:
        low, high = self._mesh(field).bounds
        padded = [(low - 0.1 * (high - low)).tolist(), (high + 0.1 * (high - low)).tolist()]
        report = {"family": "mesh", "bounds": padded, "surface_bounds": [low.tolist(), high.tolist()]}
        self._records.update_field(field.sha256, attempt=field.attempt, state="ready", report=report, views="pending")

    def _import_recording(self, field: FieldRecord) -> None:
        with self._blobs.open(original_key(field.sha256)) as file:
            data = file.read()
        with TemporaryDirectory() as temporary:
            folder = Path(temporary)
            (folder / "sent.safetensors").write_bytes(data)
            if data.startswith(b"PK"):
                zipfile.ZipFile(io.BytesIO(data)).extractall(folder / "unpacked")
            recording = open_recording(folder / ("unpacked" if data.startswith(b"PK") else "sent.safetensors"))
            write_recording(recording, range(len(recording)), folder / "made.safetensors")
            self._blobs.put(view_key(field.sha256, "field.safetensors"), (folder / "made.safetensors").read_bytes())
        report = {"kind": "recording", "layout": recording.layout, "frames": [one.name for one in recording.frames]}
        self._records.update_field(field.sha256, attempt=field.attempt, state="ready", report=report, views="none")

    def _draw(self, field: FieldRecord) -> None:
        mesh = self._mesh(field)
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0 if mesh.visual.kind == "vertex" else None
        self._blobs.put(f"fields/{field.sha256}/mesh.glb", mesh_file(mesh.vertices, mesh.faces, colors=colors))
        self._blobs.put(f"fields/{field.sha256}/preview.png", field_picture(sha256_of(field.sha256)))
        self._records.update_field(field.sha256, attempt=field.attempt, views="ready")

    def _mesh(self, field: FieldRecord) -> trimesh.Trimesh:
        name = sha256_of(field.sha256)
        if name not in _READ:
            with self._blobs.open(original_key(field.sha256)) as file:
                data = file.read()
            kind = "glb" if data.startswith(b"glTF") else "ply"
            _READ[name] = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh")
        return _READ[name]

    def _finish(self, job: JobRecord) -> None:
        self._records.update_job(job.id, 1, status="running", phase="optimizing", progress=0.5)
        scene_object = np.array(self._pose)
        candidates = job.request.get("candidates")
        candidates = candidates and [sha256_of(one) for one in candidates]
        found = job.inputs.get("object") or candidates[0]
        result: dict[str, Any] = {
            "verdict": "registered",
            "verdict_reason": "SURFACES_AGREE",
            "verdict_detail": "Object and scene match on the verification samples.",
            "object": found,
            "candidates": candidates and [{"object": one, "stage": "refined", "score": 0.1} for one in candidates],
            "T_object_scene": _transform(np.linalg.inv(scene_object)),
            "T_scene_object": _transform(scene_object),
            "probability": 0.97,
            "level": "default",
            "metrics": {"probability": 0.97, "residual_rms": 0.002, "seconds": {"sampling": 0.5, "optimizing": 1.5}},
            "options": {"preset": "robust", "up_axis": "z", "robust": {"rotations": 600}},
            "seed": 0,
        }
        files = {}
        scene = self._records.get_field(str(job.request["scene"]))
        if scene is not None and scene.is_recording:
            result["camera"] = seen_by_camera(scene_object)
            files["overlay.png"] = OVERLAY
        files["result.json"] = json.dumps(result).encode()
        for name, data in files.items():
            self._blobs.put(f"jobs/{job.id}/1/{name}", data)
        listed = [
            {"name": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        ]
        self._blobs.put(f"jobs/{job.id}/manifest.json", json.dumps({"attempt": 1, "artifacts": listed}).encode())
        searched = {"object_found": found} if candidates else {}
        told = {name: result[name] for name in ("verdict", "probability", "level")}
        self._records.update_job(job.id, 1, status="successful", **told, **searched)


def seen_by_camera(scene_object: np.ndarray[Any, Any]) -> dict[str, Any]:
    """A camera 2 m before the scene's origin, which looks along its y axis, z up."""
    scene_camera = np.array([[1.0, 0, 0, 0], [0, 0, 1, -2], [0, -1, 0, 0], [0, 0, 0, 1]])
    camera_object = np.linalg.inv(scene_camera) @ scene_object
    return {
        "frame": "b", "T_camera_object": _transform(camera_object), "T_scene_camera": _transform(scene_camera),
        "center_camera": camera_object[:3, 3].tolist(), "object_unit_m": 0.001,
    }  # fmt: skip


def _transform(matrix: np.ndarray[Any, Any]) -> dict[str, Any]:
    return {"matrix": matrix.tolist(), "scale": float(np.cbrt(np.linalg.det(matrix[:3, :3])))}

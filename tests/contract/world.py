"""A service in one process over an emptied Redis and a folder, and the small things that tests ask of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI
from redis import Redis

from regnf_service.server import create_app
from regnf_state.queue import Work
from regnf_state.records import JobRecord
from regnf_state.settings import Settings
from tests.contract.asgi import client_of
from tests.stores import HeldBlobs, ShiftedJournaledRecords, WatchedQueue, stores_over

_APPS: list[FastAPI] = []
BOX = {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]}
BOUNDS = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
NOBODY = "0" * 32
TOKENS = frozenset({"alice:the-secret-of-alice", "bob:the-secret-of-bob"})
ALICE = {"Authorization": "Bearer the-secret-of-alice"}
BOB = {"Authorization": "Bearer the-secret-of-bob"}


def field_bytes(name: str, size: int = 600) -> bytes:
    header = json.dumps({"__metadata__": {"name": name}}).encode()
    return (len(header).to_bytes(8, "little") + header).ljust(size, b"\0")


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def put(client: httpx.Client, data: bytes, **headers: str) -> httpx.Response:
    return client.put(f"/fields/{sha256(data)}", content=data, headers=headers)


def transform(scale: float = 1.0) -> dict[str, Any]:
    matrix = [[scale, 0, 0, 0], [0, scale, 0, 0], [0, 0, scale, 0], [0, 0, 0, 1]]
    return {"matrix": matrix, "scale": scale, "rotation_quaternion_xyzw": [0, 0, 0, 1], "translation": [0, 0, 0]}


RESULT = {
    "verdict": "registered", "verdict_reason": "SURFACES_AGREE", "probability": 0.95, "level": "default",
    "T_scene_object": transform(0.5), "T_object_scene": transform(2.0), "center_scene": [0.0, 0.0, 0.0],
    "center_object": [0.0, 0.0, 0.0], "alternatives": [], "metrics": {"residual_rms": 0.001}, "seed": 0,
}  # fmt: skip


@dataclass
class World:
    settings: Settings
    redis: Redis
    records: ShiftedJournaledRecords
    blobs: HeldBlobs
    queue: WatchedQueue
    app: FastAPI
    client: httpx.Client

    def ready_field(self, name: str, bounds: list[list[float]] | None = None) -> str:
        """A field that was uploaded and whose import went well; its SHA-256."""
        data = field_bytes(name)
        answer = self.client.put(f"/fields/{sha256(data)}", content=data)
        assert answer.status_code == 201, answer.text
        self.blobs.delete(f"fields/{sha256(data)}/original")
        self.queue.remove(Work("import", sha256(data), 1).name)
        self.records.update_field(sha256(data), attempt=1, state="ready", report={"bounds": bounds or BOUNDS})
        return sha256(data)

    def rejected_field(self, name: str) -> str:
        data = field_bytes(name)
        self.client.put(f"/fields/{sha256(data)}", content=data)
        self.blobs.delete_prefix(f"fields/{sha256(data)}")
        error = {"reason": "FIELD_SHAPES_MISMATCH", "title": "Shapes", "status": 422, "detail": "the shapes do not fit"}
        self.records.update_field(sha256(data), attempt=1, state="rejected", error=error)
        return sha256(data)

    def submit(self, **changes: Any) -> str:
        answer = self.client.post("/register", json=self.valid_request() | changes)
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def valid_request(self) -> dict[str, Any]:
        """A request between two fields that are there, uploading them the first time."""
        scene, object_ = sha256(field_bytes("scene")), sha256(field_bytes("object"))
        for name, known in (("scene", scene), ("object", object_)):
            if self.records.get_field(known) is None:
                self.ready_field(name)
        return {"scene": scene, "object": object_, "detection": BOX}

    def job(self, job_id: str) -> JobRecord:
        record = self.records.get_job(job_id)
        assert record is not None
        return record

    def run(self, job_id: str) -> JobRecord:
        record = self.job(job_id)
        if record.status == "running":
            return record
        return self.records.update_job(job_id, record.attempt, status="running", phase="loading")

    def succeed(self, job_id: str, artifacts: dict[str, bytes] | None = None, **later: Sequence[str]) -> None:
        """What a worker leaves behind in the end; ``pending`` is still to come, ``on_request`` to be drawn."""
        attempt = self.run(job_id).attempt
        files = {"result.json": json.dumps(RESULT).encode()} | (artifacts or {})
        listed = self._put(job_id, attempt, files)
        document = {"attempt": attempt, "artifacts": listed} | {name: list(files) for name, files in later.items()}
        self.blobs.put(f"jobs/{job_id}/manifest.json", json.dumps(document).encode())
        result = json.loads(files["result.json"])
        told = {name: result.get(name) for name in ("verdict", "probability", "level")}
        self.records.update_job(job_id, attempt, status="successful", **told)

    def finish(self, job_id: str, artifacts: dict[str, bytes]) -> None:
        """What it leaves behind of what was still to come."""
        document = {"artifacts": self._put(job_id, 1, artifacts), "missing": []}
        self.blobs.put(f"jobs/{job_id}/rest.json", json.dumps(document).encode())

    def _put(self, job_id: str, attempt: int, files: dict[str, bytes]) -> list[dict[str, Any]]:
        for name, data in files.items():
            self.blobs.put(f"jobs/{job_id}/{attempt}/{name}", data)
        return [
            {"name": name, "bytes": len(data), "media_type": "application/octet-stream", "sha256": sha256(data)}
            for name, data in files.items()
        ]

    def fail(self, job_id: str, **error: Any) -> None:
        attempt = self.run(job_id).attempt
        self.records.update_job(job_id, attempt, status="failed", error=error)


def pointers(problem: dict[str, Any]) -> list[str]:
    return [one["pointer"] for one in problem["errors"]]


def share_routes(app: FastAPI) -> None:
    """Give every application the routes and the contract of the first one: no setting changes them, and the framework
    takes longer to work them out, at an application's first request, than most tests take for theirs."""
    _APPS.append(app)
    del _APPS[1:]
    app.router.routes[:] = _APPS[0].router.routes
    app.openapi = _APPS[0].openapi  # type: ignore[method-assign]


def make_world(folder: Path, redis: Redis, **settings: Any) -> World:
    """A fresh service; ``settings`` override what suits tests. Redis is emptied."""
    usual = {"state_dir": folder, "redis_url": None, "max_upload_bytes": 4096}
    chosen = Settings(**(usual | settings))
    stores = stores_over(redis, chosen.blob_dir, chosen.job_retention_s)
    app = create_app(chosen, stores)
    share_routes(app)
    return World(chosen, redis, stores.records, stores.blobs, stores.queue, app, client_of(app))


def assert_refused(answer: httpx.Response, status: int, reason: str) -> dict[str, Any]:
    """The answer is a whole problem with this status and reason; returns it."""
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    problem: dict[str, Any] = answer.json()
    assert (answer.status_code, problem["reason"]) == (status, reason), answer.text
    assert problem["status"] == status
    assert problem["type"] == f"/docs#{reason}"
    assert problem["title"]
    assert problem["detail"]
    assert problem["request_id"] == answer.headers["x-request-id"]
    assert "Traceback" not in answer.text
    return problem

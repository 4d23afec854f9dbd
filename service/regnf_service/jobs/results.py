"""What a successful job left in the blob store, found through its manifest."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from regnf_state.blobs.base import BlobStore

ARTIFACTS: dict[str, str] = {
    "scene_points.ply": "application/octet-stream",
    "object_points.ply": "application/octet-stream",
    "aligned.ply": "application/octet-stream",
    "context_points.ply": "application/octet-stream",
    "residuals.npz": "application/octet-stream",
    "trace.json": "application/json",
    "transform.npy": "application/octet-stream",
    "aligned.glb": "model/gltf-binary",
    "recording.rrd": "application/octet-stream",
    "preview.png": "image/png",
    "result.json": "application/json",
}
"""Every name an artifact can have, with its media type. Nothing else is ever looked up."""


@dataclass(frozen=True)
class Artifact:
    """One file that an attempt wrote."""

    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """The attempt that counts, and what it wrote, by name."""

    job_id: str
    attempt: int
    artifacts: dict[str, Artifact]

    def key(self, name: str) -> str:
        """Where an artifact lies."""
        return f"jobs/{self.job_id}/{self.attempt}/{name}"


def read_manifest(blobs: BlobStore, job_id: str) -> Manifest | None:
    """The job's manifest, with the artifacts whose names we know; None when it has none."""
    try:
        with blobs.open(f"jobs/{job_id}/manifest.json") as file:
            document = json.load(file)
    except FileNotFoundError:
        return None
    listed = {entry["name"]: Artifact(entry["bytes"], entry["sha256"]) for entry in document["artifacts"]}
    return Manifest(job_id, document["attempt"], {name: entry for name, entry in listed.items() if name in ARTIFACTS})


def read_result(blobs: BlobStore, manifest: Manifest) -> dict[str, Any]:
    """The result document as the worker wrote it."""
    with blobs.open(manifest.key("result.json")) as file:
        document: dict[str, Any] = json.load(file)
    return document

"""Results into the blob store: artifacts under their attempt, then the manifest, which makes them count."""

from __future__ import annotations

import hashlib
import json
import mimetypes
from pathlib import Path
from typing import Any

from regnf_state.blobs.base import BlobStore

_CHUNK_BYTES = 1 << 20
_MEDIA_TYPES = {
    ".npy": "application/octet-stream",
    ".npz": "application/zip",
    ".ply": "application/octet-stream",
    ".glb": "model/gltf-binary",
    ".json": "application/json",
    ".png": "image/png",
}

_VERDICTS = ("registered", "ambiguous", "rejected")
Manifest = dict[str, Any]


def manifest_key(job_id: str) -> str:
    return f"jobs/{job_id}/manifest.json"


def read_manifest(blobs: BlobStore, job_id: str) -> Manifest | None:
    """The job's result as it stands: {attempt, artifacts: [{name, bytes, media_type, sha256}]}; None without one."""
    try:
        with blobs.open(manifest_key(job_id)) as file:
            manifest: Manifest = json.load(file)
    except FileNotFoundError:
        return None
    return manifest


def verdict_of(blobs: BlobStore, job_id: str, manifest: Manifest) -> str | None:
    """What the result that the manifest lists says of itself; None for one that says nothing that is known."""
    try:
        with blobs.open(f"jobs/{job_id}/{manifest['attempt']}/result.json") as file:
            verdict = json.load(file).get("verdict")
    except (FileNotFoundError, ValueError, AttributeError):
        return None
    return verdict if verdict in _VERDICTS else None


def store_artifacts(blobs: BlobStore, job_id: str, attempt: int, folder: Path, names: list[str]) -> Manifest:
    """Copy files into the store under the attempt. They do not count before the manifest is published."""
    artifacts = [_store(blobs, f"jobs/{job_id}/{attempt}/{name}", folder / name) for name in names]
    return {"attempt": attempt, "artifacts": artifacts}


def publish(blobs: BlobStore, job_id: str, manifest: Manifest) -> bool:
    """Make the result stand. False when another attempt's stands already: a job has one result, ever."""
    return blobs.put_if_absent(manifest_key(job_id), json.dumps(manifest, indent=1).encode())


def discard(blobs: BlobStore, job_id: str, attempt: int) -> None:
    """Drop what an attempt wrote that does not count."""
    blobs.delete_prefix(f"jobs/{job_id}/{attempt}")


def discard_others(blobs: BlobStore, job_id: str, manifest: Manifest) -> None:
    """Drop what other attempts have left behind, now that they can no longer publish it."""
    keep = {
        manifest_key(job_id),
        *(f"jobs/{job_id}/{manifest['attempt']}/{one['name']}" for one in manifest["artifacts"]),
    }
    for key in blobs.list(f"jobs/{job_id}"):
        if key not in keep:
            blobs.delete(key)


def _store(blobs: BlobStore, key: str, path: Path) -> dict[str, Any]:
    digest = hashlib.sha256()
    with path.open("rb") as source, blobs.writer() as writer:
        while chunk := source.read(_CHUNK_BYTES):
            digest.update(chunk)
            writer.write(chunk)
        writer.commit(key)
    return {
        "name": path.name,
        "bytes": path.stat().st_size,
        "media_type": _MEDIA_TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream",
        "sha256": digest.hexdigest(),
    }

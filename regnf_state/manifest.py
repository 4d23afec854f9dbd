"""The result of a job in the blob store: files under the attempt that wrote them, and a manifest that makes them count.

The manifest is written last and never changed. It names the attempt and lists its files.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from regnf_state.blobs.base import BlobStore
from regnf_state.record_format import FORMAT, check_json_format
from regnf_state.records import UnreadableRecordError

_BINARY = "application/octet-stream"
ARTIFACTS: dict[str, str] = {
    "scene_points.ply": _BINARY,
    "object_points.ply": _BINARY,
    "aligned.ply": _BINARY,
    "context_points.ply": _BINARY,
    "residuals.npz": _BINARY,
    "trace.json": "application/json",
    "transform.npy": _BINARY,
    "aligned.glb": "model/gltf-binary",
    "recording.rrd": _BINARY,
    "preview.png": "image/png",
    "result.json": "application/json",
}
"""Every name that an artifact can have, with its media type. The service serves no other."""


@dataclass(frozen=True)
class Artifact:
    """One file that an attempt wrote."""

    name: str
    bytes: int
    sha256: str

    @property
    def media_type(self) -> str:
        return ARTIFACTS.get(self.name, _BINARY)


@dataclass(frozen=True)
class Manifest:
    """The attempt whose result counts, and its files."""

    job_id: str
    attempt: int
    artifacts: tuple[Artifact, ...]

    def key(self, name: str) -> str:
        """Where the blob store holds a file."""
        return artifact_key(self.job_id, self.attempt, name)

    def served(self) -> dict[str, Artifact]:
        """The files that the service serves, by name."""
        return {one.name: one for one in self.artifacts if one.name in ARTIFACTS}

    def keys(self) -> Iterable[str]:
        """Where everything that counts is held, the manifest included."""
        return (manifest_key(self.job_id), *(self.key(one.name) for one in self.artifacts))

    def to_json(self) -> bytes:
        listed = [
            {"name": one.name, "bytes": one.bytes, "media_type": one.media_type, "sha256": one.sha256}
            for one in self.artifacts
        ]
        return json.dumps({"format": FORMAT, "attempt": self.attempt, "artifacts": listed}, indent=1).encode()


def manifest_key(job_id: str) -> str:
    return f"jobs/{job_id}/manifest.json"


def artifact_key(job_id: str, attempt: int, name: str) -> str:
    return f"jobs/{job_id}/{attempt}/{name}"


def read_manifest(blobs: BlobStore, job_id: str) -> Manifest | None:
    """The manifest of a job's result; None while there is none. Raises UnreadableRecordError."""
    try:
        with blobs.open(manifest_key(job_id)) as file:
            document = check_json_format(job_id, json.load(file))
        attempt = document["attempt"]
        listed = [Artifact(one["name"], one["bytes"], one["sha256"]) for one in document["artifacts"]]
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise UnreadableRecordError(job_id, "its manifest is damaged") from error
    if not (isinstance(attempt, int) and all(_is_sound(one) for one in listed)):
        raise UnreadableRecordError(job_id, "its manifest is damaged")
    return Manifest(job_id, attempt, tuple(listed))


def _is_sound(one: Artifact) -> bool:
    return isinstance(one.name, str) and isinstance(one.bytes, int) and isinstance(one.sha256, str) and one.bytes >= 0


def read_result(blobs: BlobStore, manifest: Manifest) -> dict[str, Any]:
    """The result document. Raises FileNotFoundError, UnreadableRecordError."""
    with blobs.open(manifest.key("result.json")) as file:
        try:
            document = json.load(file)
        except ValueError as error:
            raise UnreadableRecordError(manifest.job_id, "its result is damaged") from error
    if not isinstance(document, dict):
        raise UnreadableRecordError(manifest.job_id, "its result is damaged")
    return document

"""The result of a job in the blob store: files under the attempt that wrote them, and a manifest that makes them count.

The manifest is written after these files and never changed. It names the attempt and lists its files, and the names of
those that are to come: clouds and pictures, which are made once the result is out. A second document, the rest, lists
what has become of them. It is written once as well. So is a third, which lists what was drawn when somebody asked.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any

from pydantic import Field, StrictInt, TypeAdapter

from regnf_state.blobs.base import BlobStore
from regnf_state.records import FORMAT, UnreadableRecordError, check_json_format

_BINARY = "application/octet-stream"
EDITED_FIELD = "edited.safetensors"
"""A rendering's scene with its edits, as a field."""
ARTIFACTS: dict[str, str] = {
    "scene_points.ply": _BINARY,
    "object_points.ply": _BINARY,
    "aligned.ply": _BINARY,
    "context_points.ply": _BINARY,
    "difference.ply": _BINARY,
    "residuals.npz": _BINARY,
    "considered.npz": _BINARY,
    "trace.json": "application/json",
    "T_scene_object.npy": _BINARY,
    "aligned.glb": "model/gltf-binary",
    "recording.rrd": _BINARY,
    "preview.png": "image/png",
    "overlay.png": "image/png",
    "result.json": "application/json",
    "before-after.png": "image/png",
    "animation.webp": "image/webp",
    "composite.glb": "model/gltf-binary",
    EDITED_FIELD: _BINARY,
    "render.json": "application/json",
}
"""Names that an artifact can have, with its media type."""
_FRAMES = {".png": "image/png", "-depth.png": "image/png", "-normal.png": "image/png", "-depth.npy": _BINARY}
_FRAME = re.compile(rf"(?:frame|before)-[0-9]{{4}}(?P<what>{'|'.join(map(re.escape, _FRAMES))})")
_MOST_RESULT_BYTES = 4 << 20
"""A search among 512 candidates has 1 MB, a rendering of the most images less."""
MEDIA_TYPES = frozenset({*ARTIFACTS.values(), *_FRAMES.values()})


def media_type_of(name: str) -> str | None:
    """The media type of an artifact; None for a name that no artifact has, and the service serves none of these."""
    frame = _FRAME.fullmatch(name)
    return ARTIFACTS.get(name) if frame is None else _FRAMES[frame["what"]]


@dataclass(frozen=True)
class Artifact:
    """One file that an attempt wrote."""

    name: str
    bytes: Annotated[int, Field(strict=True, ge=0)]
    sha256: str

    @property
    def media_type(self) -> str:
        return media_type_of(self.name) or _BINARY


@dataclass(frozen=True)
class Manifest:
    """The attempt whose result counts, and its files."""

    job_id: str
    attempt: int
    artifacts: tuple[Artifact, ...]
    pending: tuple[str, ...] = ()
    """Names of files that are still to come, if their making does not fail."""
    missing: tuple[str, ...] = ()
    """Names of files that were to come and do not."""
    on_request: tuple[str, ...] = ()
    """Names of files that the front end draws of the others when somebody asks for one."""

    def key(self, name: str) -> str:
        """Where the blob store holds a file."""
        return artifact_key(self.job_id, self.attempt, name)

    def served(self) -> dict[str, Artifact]:
        """The files that the service serves, by name."""
        return {one.name: one for one in self.artifacts if media_type_of(one.name) is not None}

    def keys(self) -> Iterable[str]:
        """Where everything that counts is held, the manifest included."""
        own = (self.key(one.name) for one in self.artifacts)
        return (manifest_key(self.job_id), rest_key(self.job_id), self.drawn_key, *own)

    @property
    def drawn_key(self) -> str:
        """Where what was drawn is listed. Under the attempt: a drawing may outlive its job, and meet the next one."""
        return self.key("drawn.json")

    def to_json(self) -> bytes:
        """The document of a result as it is published."""
        document: dict[str, Any] = {"attempt": self.attempt, "artifacts": _listed(self.artifacts)}
        later = {"pending": list(self.pending), "on_request": list(self.on_request)}
        return _document(document | {name: files for name, files in later.items() if files})


@dataclass(frozen=True)
class Rest:
    """What has become of the files that were to come, or to be drawn."""

    artifacts: tuple[Artifact, ...] = ()
    missing: tuple[str, ...] = ()

    def to_json(self) -> bytes:
        return _document({"artifacts": _listed(self.artifacts), "missing": list(self.missing)})


@dataclass(frozen=True)
class _Document:
    """A manifest or a rest, as it is read."""

    artifacts: tuple[Artifact, ...]
    attempt: StrictInt = 0
    pending: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    on_request: tuple[str, ...] = ()


_DOCUMENT = TypeAdapter(_Document)


def _document(members: dict[str, Any]) -> bytes:
    return json.dumps({"format": FORMAT} | members, indent=1).encode()


def _listed(artifacts: Iterable[Artifact]) -> list[dict[str, Any]]:
    return [
        {"name": one.name, "bytes": one.bytes, "media_type": one.media_type, "sha256": one.sha256} for one in artifacts
    ]


def manifest_key(job_id: str) -> str:
    return f"jobs/{job_id}/manifest.json"


def rest_key(job_id: str) -> str:
    return f"jobs/{job_id}/rest.json"


def artifact_key(job_id: str, attempt: int, name: str) -> str:
    return f"jobs/{job_id}/{attempt}/{name}"


def read_manifest(blobs: BlobStore, job_id: str) -> Manifest | None:
    """The manifest of a job's result with what has come since; None while there is none.

    Raises UnreadableRecordError.
    """
    first = _read(blobs, job_id, manifest_key(job_id))
    if first is None:
        return None
    if not first.attempt:
        raise UnreadableRecordError(job_id, "its manifest is damaged")
    now = Manifest(job_id, first.attempt, first.artifacts, first.pending, on_request=first.on_request)
    rest = _read(blobs, job_id, rest_key(job_id)) if now.pending else None
    if rest is not None:
        now = replace(now, artifacts=now.artifacts + rest.artifacts, pending=(), missing=rest.missing)
    if now.missing:  # and so is what would be drawn of them
        return without_drawings(now)
    drawn = _read(blobs, job_id, now.drawn_key) if now.on_request and not now.pending else None
    if drawn is None:
        return now
    return replace(now, artifacts=now.artifacts + drawn.artifacts, missing=drawn.missing, on_request=())


def without_drawings(manifest: Manifest) -> Manifest:
    """The same where nothing can be drawn, since files are missing."""
    return replace(manifest, missing=manifest.missing + manifest.on_request, on_request=())


def _read(blobs: BlobStore, job_id: str, key: str) -> _Document | None:
    try:
        with blobs.open(key) as file:
            return _DOCUMENT.validate_python(check_json_format(job_id, json.load(file)))
    except FileNotFoundError:
        return None
    except ValueError as error:  # pydantic's are
        raise UnreadableRecordError(job_id, "its manifest is damaged") from error


def read_result(blobs: BlobStore, manifest: Manifest) -> dict[str, Any]:
    """The result document. Raises FileNotFoundError, UnreadableRecordError, also for one larger than any can be."""
    with blobs.open(manifest.key("result.json")) as file:
        text = file.read(_MOST_RESULT_BYTES + 1)
    if len(text) > _MOST_RESULT_BYTES:
        raise UnreadableRecordError(manifest.job_id, "its result is too large")
    try:
        document = json.loads(text)
    except ValueError as error:
        raise UnreadableRecordError(manifest.job_id, "its result is damaged") from error
    if not isinstance(document, dict):
        raise UnreadableRecordError(manifest.job_id, "its result is damaged")
    return document

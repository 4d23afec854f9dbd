"""Results into the blob store: files under their attempt, then the manifest, which makes them count."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from regnf_state.blobs.base import BlobStore
from regnf_state.manifest import Artifact, Manifest, Rest, artifact_key, manifest_key, read_result, rest_key
from regnf_state.records import UnreadableRecordError

_CHUNK_BYTES = 1 << 20
_VERDICTS = ("registered", "ambiguous", "rejected")


def told_by_result(blobs: BlobStore, manifest: Manifest) -> dict[str, str | None]:
    """What the job's record says of its result: the verdict if it is a known one, and of a search the object found."""
    try:
        result = read_result(blobs, manifest)
    except (FileNotFoundError, UnreadableRecordError):
        return {}
    verdict, found = result.get("verdict"), result.get("object")
    return {
        "verdict": verdict if verdict in _VERDICTS else None,
        "object_found": found if isinstance(found, str) and result.get("candidates") else None,
    }


def store_artifacts(
    blobs: BlobStore, job_id: str, attempt: int, folder: Path, names: Sequence[str]
) -> tuple[Artifact, ...]:
    """Copy files into the store under the attempt. They do not count before the manifest is published."""
    return tuple(_store(blobs, artifact_key(job_id, attempt, name), folder / name) for name in names)


def publish(blobs: BlobStore, manifest: Manifest) -> bool:
    """Make the result count. False when another attempt has published one already: a job has one result, ever."""
    return blobs.put_if_absent(manifest_key(manifest.job_id), manifest.to_json())


def publish_rest(blobs: BlobStore, job_id: str, rest: Rest) -> bool:
    """Say what has become of the files that were to come. False when that is said already: it is said once."""
    return blobs.put_if_absent(rest_key(job_id), rest.to_json())


def discard(blobs: BlobStore, job_id: str, attempt: int) -> None:
    """Delete what an attempt wrote that does not count."""
    blobs.delete_prefix(f"jobs/{job_id}/{attempt}")


def discard_others(blobs: BlobStore, manifest: Manifest) -> None:
    """Delete what other attempts have left behind, now that they can no longer publish it."""
    keep = set(manifest.keys())
    for key in blobs.list(f"jobs/{manifest.job_id}"):
        if key not in keep:
            blobs.delete(key)


def _store(blobs: BlobStore, key: str, path: Path) -> Artifact:
    digest = hashlib.sha256()
    with path.open("rb") as source, blobs.writer() as writer:
        while chunk := source.read(_CHUNK_BYTES):
            digest.update(chunk)
            writer.write(chunk)
        writer.commit(key)
    return Artifact(path.name, path.stat().st_size, digest.hexdigest())

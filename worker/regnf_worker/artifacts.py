"""Results into the blob store: files under their attempt, then the manifest, which makes them count."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from regnf_core.library_folder import digest_of
from regnf_core.options import Acceptance
from regnf_state.blobs.base import BlobStore
from regnf_state.manifest import EDITED_FIELD, Artifact, Manifest, artifact_key, manifest_key, read_result
from regnf_state.ownership import reference_of
from regnf_state.records import FieldRecord, QuotaError, UnreadableRecordError, quota_of
from regnf_state.room import delete_upload, original_key
from regnf_worker.models import Context

logger = logging.getLogger(__name__)

# An edited scene becomes a field of its owner, as if it had been uploaded: named by its digest, imported as any.
#
# The artifact of the rendering stays as it is. Where the owner has no room for one more field, it is all that there
# is.

_CHUNK_BYTES = 1 << 20


def keep_edited_field(context: Context, owner: str, manifest: Manifest) -> None:
    """Have the edited scene among a published result imported. Does nothing where there is none, or it is a field."""
    artifact = manifest.served().get(EDITED_FIELD)
    if artifact is None:
        return
    reference = reference_of(owner, artifact.sha256)
    try:
        known = context.records.get_field(reference)
        if known is not None and known.state != "rejected":
            return
        with context.blobs.open(manifest.key(EDITED_FIELD)) as source, context.blobs.writer() as writer:
            shutil.copyfileobj(source, writer, _CHUNK_BYTES)
            writer.commit(original_key(reference))
        _import(context, reference, artifact.bytes)
    except (FileNotFoundError, UnreadableRecordError) as error:
        logger.warning("the edited scene of job %s is not a valid field: %s", manifest.job_id, error)


def _import(context: Context, reference: str, size: int) -> None:
    now = context.records.now()
    field = FieldRecord(reference, "validating", size, now, now)
    try:
        record, _ = context.records.create_field(field, quota_of(context.settings))
    except QuotaError as error:
        delete_upload(context.blobs, field)
        logger.info("the edited scene %s is not a valid field: %s", reference, error.reason)
        return
    if record.state == "validating":
        context.queue.enqueue_import(reference, record.attempt)


_VERDICTS = ("registered", "ambiguous", "rejected")


def told_by_result(blobs: BlobStore, manifest: Manifest) -> dict[str, str | float | None]:
    """What the job's record says of its result: verdict and level if they are known ones, the probability, and of a
    search the object found."""
    try:
        result = read_result(blobs, manifest)
    except (FileNotFoundError, UnreadableRecordError):
        return {}
    verdict, probability, level, found = (result.get(name) for name in ("verdict", "probability", "level", "object"))
    return {
        "verdict": verdict if verdict in _VERDICTS else None,
        "probability": probability if isinstance(probability, float) else None,
        "level": level if level in get_args(Acceptance) else None,
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
    with path.open("rb") as source, blobs.writer() as writer:
        shutil.copyfileobj(source, writer, _CHUNK_BYTES)
        writer.commit(key)
    return Artifact(path.name, path.stat().st_size, digest_of(path))

"""An edited scene becomes a field of its owner, as if it had been uploaded: named by its digest, imported as any.

The artifact of the rendering stays as it is. Where the owner has no room for one more field, it is all that there is.
"""

from __future__ import annotations

import logging

from regnf_state.manifest import EDITED_FIELD, Manifest
from regnf_state.originals import delete_upload, original_key
from regnf_state.ownership import reference_of
from regnf_state.quota import quota_of
from regnf_state.records import FieldRecord, QuotaError, UnreadableRecordError
from regnf_worker.context import Context

_CHUNK_BYTES = 1 << 20
logger = logging.getLogger(__name__)


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
            while chunk := source.read(_CHUNK_BYTES):
                writer.write(chunk)
            writer.commit(original_key(reference))
        _import(context, reference, artifact.bytes)
    except (FileNotFoundError, UnreadableRecordError) as error:
        logger.warning("the edited scene of job %s is no field: %s", manifest.job_id, error)


def _import(context: Context, reference: str, size: int) -> None:
    now = context.records.now()
    field = FieldRecord(reference, "validating", size, now, now)
    try:
        record, _ = context.records.create_field(field, quota_of(context.settings))
    except QuotaError as error:
        delete_upload(context.blobs, field)
        logger.info("the edited scene %s is no field: %s", reference, error.reason)
        return
    if record.state == "validating":
        context.queue.enqueue_import(reference, record.attempt)

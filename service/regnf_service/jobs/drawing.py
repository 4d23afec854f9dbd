"""The picture of a result, drawn of its stored files when it is requested the first time, and kept beside them."""

from __future__ import annotations

import hashlib
import logging

from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_state.manifest import Artifact, Manifest, Rest, read_manifest

logger = logging.getLogger(__name__)


def drawn(services: Services, manifest: Manifest) -> Manifest:
    """The manifest of a result once what is drawn on request is drawn, or said to be missing: that is said once.

    A job that is deleted meanwhile keeps nothing of it. Raises Problem JOB_EXPIRED, UnreadableRecordError, OSError.
    """
    blobs, job_id = services.blobs, manifest.job_id
    now = read_manifest(blobs, job_id)  # others may have asked while this request waited for its turn
    if now is not None and now.on_request:
        kept = [_kept(services, now, name) for name in now.on_request]
        artifacts = tuple(one for one in kept if one is not None)
        rest = Rest(artifacts, missing=() if artifacts else now.on_request)
        blobs.put_if_absent(now.drawn_key, rest.to_json())
        if services.records.get_job(job_id) is None:
            blobs.delete_prefix(f"jobs/{job_id}")
        now = read_manifest(blobs, job_id)
    if now is None or now.attempt != manifest.attempt:
        raise Problem("JOB_EXPIRED")
    return now


def _kept(services: Services, manifest: Manifest, name: str) -> Artifact | None:
    from regnf_core.viewing.registration_picture import stored_picture

    try:
        data = stored_picture(lambda part: services.blobs.open(manifest.key(part)))
    except (FileNotFoundError, ValueError, LookupError, TypeError) as error:
        logger.warning("job %s: its picture cannot be drawn: %s", manifest.job_id, error)
        return None
    services.blobs.put(manifest.key(name), data)
    return Artifact(name, len(data), hashlib.sha256(data).hexdigest())

"""What happens to an upload once all its bytes are here: its record, and its way to the import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from regnf_core.importing.upload_description import UploadDescription
from regnf_service.budget import check_budget
from regnf_service.concurrency import in_thread
from regnf_service.fields.uploads import Received, Upload
from regnf_service.problem import CLOSE, RETRY_LATER, Problem
from regnf_service.services import Services
from regnf_state.ownership import reference_of
from regnf_state.records import FieldRecord, QuotaError, UnreadableRecordError


def function_of(description: UploadDescription) -> dict[str, Any]:
    """What the import needs of a description: everything that was said but the label."""
    return {name: value for name, value in description.non_default().items() if name != "label"}


def check_room(services: Services, caller: str, sha256: str) -> int | None:
    """Refuse an upload before it comes if the caller has no room for one more field. Raises Problem.

    Returns the room for its bytes, as ``room_for_bytes``.
    """
    known = _known(services, reference_of(caller, sha256))
    if known is not None and known.state != "rejected":
        return room_for_bytes(services, caller, known)
    check_workers(services, caller, CLOSE)
    most = services.quota.fields
    if most is not None and services.records.stored(caller)[0] >= most:
        raise Problem("QUOTA_FIELDS", headers=CLOSE)
    return room_for_bytes(services, caller)


def room_for_bytes(services: Services, caller: str, again: FieldRecord | None = None) -> int | None:
    """How many bytes the caller may have under way: its quota less what it has stored. None: any number.

    A field that is sent ``again`` takes no more than it has.
    """
    most = services.quota.stored_bytes
    if most is None:
        return None
    return most - services.records.stored(caller)[1] + (0 if again is None else again.kept_bytes)


def _known(services: Services, reference: str) -> FieldRecord | None:
    """The field that is held; a damaged record does not keep its bytes from being sent again.

    Raises UnreadableRecordError for a record of a later release.
    """
    try:
        return services.records.get_field(reference)
    except UnreadableRecordError as error:
        if error.newer:
            raise
        return None


def check_workers(services: Services, caller: str, headers: Mapping[str, str] | None = None) -> None:
    """Refuse an import that the workers have no time for. Raises Problem QUOTA_IMPORTS, QUOTA_WORKER_SECONDS."""
    check_budget(services, caller, headers)
    most = services.quota.imports
    if most is not None and services.records.importing(caller) >= most:
        raise Problem("QUOTA_IMPORTS", headers={**(headers or {}), **RETRY_LATER})


@dataclass(frozen=True)
class StoredUpload:
    """A field that was taken in. ``created``: it was not held before, or had been rejected and is tried anew."""

    record: FieldRecord
    created: bool


def original_key(reference: str) -> str:
    """Where the uploaded bytes lie until the import has ended."""
    return f"fields/{reference}/original"


async def store_upload(
    services: Services, caller: str, upload: Upload, received: Received, description: UploadDescription | None = None
) -> StoredUpload:
    """Keep a finished upload unless the caller has its bytes already, and see to it that its import is queued.

    Raises Problem FIELD_DESCRIPTION_DIFFERS when the same bytes are held as another function, QUOTA_IMPORTS,
    QUOTA_WORKER_SECONDS, and QuotaError.
    """
    reference = reference_of(caller, received.sha256)
    known = await in_thread(_known, services, reference)
    if known is not None and known.state != "rejected":
        return await in_thread(_keep, services, known, description)
    field = await in_thread(_field, services, reference, received.bytes, description)
    if field.state == "rejected":
        return StoredUpload((await in_thread(services.records.create_field, field))[0], created=True)
    await in_thread(check_workers, services, caller)
    await in_thread(services.room.make, caller)
    await upload.commit(original_key(reference))
    return await in_thread(_record, services, field, description)


def _keep(services: Services, known: FieldRecord, description: UploadDescription | None) -> StoredUpload:
    if description is not None:
        if function_of(description) != known.description:
            raise Problem("FIELD_DESCRIPTION_DIFFERS")
        if description.label is not None and description.label != known.label:
            known = services.records.update_field(known.sha256, label=description.label)
    if known.state == "validating":
        # mends an import that was recorded but never queued; queueing twice changes nothing
        services.queue.enqueue_import(known.sha256, known.attempt)
    return StoredUpload(known, created=False)


def _field(services: Services, reference: str, size: int, description: UploadDescription | None) -> FieldRecord:
    """The field of a new upload: to be imported, or rejected at once if the same upload of this caller was lately."""
    now = services.records.now()
    said: dict[str, Any] = {} if description is None else function_of(description)
    field = FieldRecord(
        sha256=reference,
        state="validating",
        bytes=size,
        created=now,
        updated=now,
        label=None if description is None else description.label,
        description=said,
    )
    error = services.records.known_rejection(field)
    return field if error is None else replace(field, state="rejected", error=error)


def _record(services: Services, field: FieldRecord, description: UploadDescription | None) -> StoredUpload:
    try:
        record, created = services.records.create_field(field, services.quota)
    except QuotaError:
        services.blobs.delete(original_key(field.sha256))
        raise
    if record.state == "ready":
        # another upload of the same bytes came first and is imported already
        services.blobs.delete(original_key(field.sha256))
    if not created:
        return _keep(services, record, description)
    services.queue.enqueue_import(record.sha256, record.attempt)
    return StoredUpload(record, created=True)

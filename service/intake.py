"""What happens to an upload once all its bytes are here: its record, and its way to the import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from regnf_core.importing.upload_description import UploadDescription
from service.dependencies import Services, off_loop
from service.ownership import reference_of
from service.problems import Problem
from service.records import FieldRecord
from service.schemas.fields import function_of
from service.uploads import Received, Upload


@dataclass(frozen=True)
class Intake:
    """A field that was taken in. ``created``: it was not held before, or had been rejected and is tried anew."""

    record: FieldRecord
    created: bool


def original_key(reference: str) -> str:
    """Where the uploaded bytes lie until the import has ended."""
    return f"fields/{reference}/original"


async def take_in(
    services: Services, caller: str, upload: Upload, received: Received, description: UploadDescription | None = None
) -> Intake:
    """Keep a finished upload unless the caller has its bytes already, and see to it that its import is queued.

    Raises Problem FIELD_DESCRIPTION_DIFFERS when the same bytes are held as another function.
    """
    reference = reference_of(caller, received.sha256)
    known = await off_loop(services.records.get_field, reference)
    if known is not None and known.state != "rejected":
        return await off_loop(_keep, services, known, description)
    await upload.commit(original_key(reference))
    return await off_loop(_record, services, reference, received.bytes, description)


def _keep(services: Services, known: FieldRecord, description: UploadDescription | None) -> Intake:
    if description is not None:
        if function_of(description) != known.description:
            raise Problem("FIELD_DESCRIPTION_DIFFERS")
        if description.label is not None and description.label != known.label:
            known = services.records.update_field(known.sha256, label=description.label)
    if known.state == "validating":
        # mends an import that was recorded but never queued; queueing twice changes nothing
        services.queue.enqueue_import(known.sha256, known.attempt)
    return Intake(known, created=False)


def _record(services: Services, reference: str, size: int, description: UploadDescription | None) -> Intake:
    now = services.records.now()
    said: dict[str, Any] = {} if description is None else function_of(description)
    record, created = services.records.create_field(
        FieldRecord(
            sha256=reference,
            state="validating",
            bytes=size,
            created=now,
            updated=now,
            label=None if description is None else description.label,
            description=said,
        )
    )
    if record.state == "ready":
        # another upload of the same bytes came first and is imported already
        services.blobs.delete(original_key(reference))
    if not created:
        return _keep(services, record, description)
    services.queue.enqueue_import(record.sha256, record.attempt)
    return Intake(record, created=True)

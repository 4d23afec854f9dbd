"""What happens to an upload once all its bytes are here: its record, and its way to the import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from regnf_core.field_source import Role, assumed_role
from regnf_core.importing.upload_description import UploadDescription
from regnf_service.concurrency import in_thread
from regnf_service.fields.uploads import Received, ReceivedSettings, Upload
from regnf_service.problem import RETRY_LATER, Problem
from regnf_service.services import Services
from regnf_state.ownership import reference_of, sha256_of
from regnf_state.records import CAMERAS, SETTINGS, FieldRecord, Quota, QuotaError, UnreadableRecordError
from regnf_state.room import delete_upload, original_key, settings_key


@dataclass(frozen=True)
class Beside:
    """What came with a file. role: what the field will be used as, which decides where nothing else does."""

    description: UploadDescription | None = None
    settings: ReceivedSettings | None = None
    cameras: ReceivedSettings | None = None
    role: Role | None = None

    @property
    def is_nothing(self) -> bool:
        """Whether the caller says nothing of the file: then any field of the same bytes is meant."""
        return self.description is None and not self.files

    @property
    def files(self) -> dict[str, ReceivedSettings]:
        """The files that came, by the entries of the record's description that say which they are."""
        found = {SETTINGS: self.settings, CAMERAS: self.cameras}
        return {entry: file for entry, file in found.items() if file is not None}

    @property
    def label(self) -> str | None:
        """The field's name for people."""
        return None if self.description is None else self.description.label

    def function(self) -> dict[str, Any]:
        """What makes another function of the same bytes: everything that was said but the label, and the files."""
        said = {} if self.description is None else function_of(self.description)
        for entry, file in self.files.items():
            said[entry] = {"name": file.name, "sha256": file.received.sha256, "bytes": file.received.bytes}
        return said

    def function_of_new(self, format_: str | None) -> dict[str, Any]:
        """The same for a field that is not held: where the file does not say how to read it, its use does."""
        said = self.function()
        return said if self.role is None else said | assumed_role(said, format_, self.role)

    def is_function_of(self, known: FieldRecord) -> bool:
        """Whether a field that is held is the same function, settings by their content. Its use is no condition."""
        said, held = self.function(), known.description
        if "as" not in said:
            held = {name: value for name, value in held.items() if name != "as"}
        return _by_content(said) == _by_content(held)


def _by_content(function: Mapping[str, Any]) -> dict[str, Any]:
    files = {entry: function[entry]["sha256"] for entry in (SETTINGS, CAMERAS) if function.get(entry) is not None}
    return {**function, **files}


def function_of(description: UploadDescription) -> dict[str, Any]:
    """What the import needs of a description: everything that was said but the label."""
    return {name: value for name, value in description.non_default().items() if name != "label"}


def check_room(services: Services, caller: str, sha256: str) -> int | None:
    """Refuse an upload before it comes if the caller has no room for one more field. Raises Problem.

    Returns the room for its bytes, as ``room_for_bytes``.
    """
    known = held_field(services, caller, sha256)
    if known is not None:
        return room_for_bytes(services, caller, known)
    check_workers(services, caller)
    most = services.quota.fields
    while most is not None and services.records.stored(caller)[0] >= most:
        if not services.originals.free(caller):
            raise Problem("QUOTA_STORED", "You have the maximum number of fields. Delete some.")
    return room_for_bytes(services, caller)


def held_field(services: Services, caller: str, sha256: str) -> FieldRecord | None:
    """The caller's field of these bytes, unless it was rejected."""
    known = _known(services, reference_of(caller, sha256))
    return None if known is None or known.state == "rejected" else known


def room_for_bytes(services: Services, caller: str, again: FieldRecord | None = None) -> int | None:
    """How many bytes the caller may have under way: its quota less what it has stored. None: any number.

    A field that is sent ``again`` takes no more than it has. Uploads that are kept after their import make room; pieces
    of uploads that are not finished take some, and so do batches.
    """
    most = services.quota.stored_bytes
    if most is None:
        return None
    stored = services.records.stored(caller)[1] - services.originals.bytes_of(caller)
    stored += services.pieces.bytes_of(caller) + services.batches.bytes_of(caller)
    return most - stored + (0 if again is None else again.kept_bytes)


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


def check_workers(services: Services, caller: str) -> None:
    """Refuse an import that the workers have no time for. Raises Problem QUOTA_ACTIVE_JOBS."""
    most = services.quota.imports
    if most is not None and services.records.importing(caller) >= most:
        detail = f"{most} of your imports are waiting or running. Wait until one ends."
        raise Problem("QUOTA_ACTIVE_JOBS", detail, headers=RETRY_LATER)


@dataclass(frozen=True)
class StoredUpload:
    """A field that was taken in. ``created``: it was not held before, or had been rejected and is tried again."""

    record: FieldRecord
    created: bool


async def store_upload(
    services: Services, caller: str, upload: Upload, received: Received, beside: Beside | None = None
) -> StoredUpload:
    """Keep a finished upload unless the caller has its bytes already, and see to it that its import is queued.

    Raises Problem FIELD_DESCRIPTION_DIFFERS when the same bytes are held as another function, QUOTA_ACTIVE_JOBS,
    and QuotaError.
    """
    beside = beside or Beside()
    reference = reference_of(caller, received.sha256)
    known = await in_thread(_known, services, reference)
    if known is not None and known.state != "rejected":
        return await in_thread(keep_held, services, known, beside)
    if known is not None and known.original_until is not None:
        await in_thread(services.originals.drop, known)  # nobody must let go of what is stored below
    field = await in_thread(_field, services, reference, upload, received, beside)
    if field.state == "validating":
        await in_thread(check_workers, services, caller)
        await in_thread(services.room.make, caller)
    elif field.original_until is None:
        return StoredUpload((await in_thread(services.records.create_field, field))[0], created=True)
    for file in beside.files.values():
        await file.upload.commit(settings_key(reference, file.received.sha256))
    await upload.commit(original_key(reference))
    return await in_thread(_record, services, field, beside)


def keep_held(services: Services, known: FieldRecord, beside: Beside) -> StoredUpload:
    """A field that the caller has already. Raises Problem FIELD_DESCRIPTION_DIFFERS."""
    if known.is_recording and beside.is_nothing:
        hint = f"They are stored as a recording: GET /recordings/{sha256_of(known.sha256)}."
        raise Problem("FIELD_DESCRIPTION_DIFFERS", hint=hint)
    if not beside.is_nothing and not beside.is_function_of(known):
        raise Problem("FIELD_DESCRIPTION_DIFFERS")
    if beside.label is not None and beside.label != known.label:
        known = services.records.update_field(known.sha256, label=beside.label)
    if known.state == "validating":
        # mends an import that was recorded but never queued; queueing twice changes nothing
        services.queue.enqueue_import(known.sha256, known.attempt)
    return StoredUpload(known, created=False)


def _field(services: Services, reference: str, upload: Upload, received: Received, beside: Beside) -> FieldRecord:
    """The field of a new upload: to be imported, or rejected at once if the same upload of this caller was lately."""
    now = services.records.now()
    field = FieldRecord(
        sha256=reference,
        state="validating",
        bytes=received.bytes,
        created=now,
        updated=now,
        label=beside.label,
        description=beside.function_of_new(upload.format),
    )
    error = services.records.known_rejection(field)
    if error is None:
        return field
    until = services.originals.kept_until(error["reason"])
    return replace(field, state="rejected", error=error, original_until=until)


def _record(services: Services, field: FieldRecord, beside: Beside) -> StoredUpload:
    record, created = _create(services, field)
    if record.state == "ready" and record.original_until is None:
        # another upload of the same bytes came first and is imported already
        services.blobs.delete(original_key(field.sha256))
    if not created:
        return keep_held(services, record, beside)
    if record.state == "validating":
        services.queue.enqueue_import(record.sha256, record.attempt)
    return StoredUpload(record, created=True)


def _create(services: Services, field: FieldRecord) -> tuple[FieldRecord, bool]:
    """The record, once there is room: uploads that are kept after their import give way. Raises QuotaError.

    A rejected field is recorded all the same, without its upload.
    """
    quota = services.quota
    if field.state == "rejected":
        quota = Quota(fields=quota.fields, stored_bytes=quota.stored_bytes)
    while True:
        try:
            return services.records.create_field(field, quota)
        except QuotaError as error:
            if error.reason == "QUOTA_STORED" and services.originals.free(field.owner):
                continue
            delete_upload(services.blobs, field)
            if field.state != "rejected":
                raise
            return services.records.create_field(replace(field, original_until=None))

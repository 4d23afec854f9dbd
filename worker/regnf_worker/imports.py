"""One attempt at importing an upload: a regnf field file and a report, or a reason why not."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from redis.exceptions import RedisError
from rq.timeouts import JobTimeoutException

from regnf_core.errors import Candidate, DatasetError, FieldFormatError, RegnfError
from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.ownership import owner_of, reference_of
from regnf_state.pieces import view_key
from regnf_state.records import CANDIDATES, FieldRecord, SettingsFile, StaleAttemptError
from regnf_state.room import candidate_key, delete_all_but_upload, delete_upload, original_key, settings_key
from regnf_worker.engine import Importer
from regnf_worker.job_limits import are_files_away, fault, refusal, timeout
from regnf_worker.models import Context
from regnf_worker.resilient_worker import retry_until_available

_CLAIM_KEPT_S = 24 * 3600
logger = logging.getLogger(__name__)


def claim_import(context: Context, sha256: str, attempt: int, worker: str) -> bool:
    """Whether this attempt at the import is this worker's: of several that ask, the first one's."""
    name = f"import:{sha256}:{attempt}"
    return context.records.set_if_absent(name, worker, _CLAIM_KEPT_S, owner_of(sha256)) == worker


def run_import_attempt(context: Context, sha256: str, attempt: int, worker: str, importer: Importer) -> None:
    """Import with ``importer(upload, folder, description, settings, cameras) -> report`` and write down how it ended.

    The original is deleted before the record changes, unless it is kept: a new upload of the same bytes finds either a
    validating record, or one that has ended, and then stores its own original. Writes that Redis refuses for
    a while are waited for, until the import's time is over. Raises RedisError, StorageUnavailableError when the end
    cannot be written down, and OSError when a volume is away.
    """
    field = context.records.get_field(sha256)
    if field is None or field.attempt != attempt or field.state != "validating":
        logger.info("import %s attempt %d is not run", sha256, attempt)
        return
    if not retry_until_available(
        f"the record of import {sha256}", lambda: claim_import(context, sha256, attempt, worker)
    ):
        logger.info("import %s attempt %d belongs to another worker", sha256, attempt)
        return
    try:
        report = _earlier_report(context, field) or _work(context, field, importer)
    except (RedisError, StorageUnavailableError):
        raise
    except RegnfError as error:
        asked = error.candidates if isinstance(error, FieldFormatError) else ()
        _refuse(context, sha256, attempt, refusal(error), asked)
    except StaleAttemptError as error:
        _retire(context, sha256, attempt, error)
    except JobTimeoutException:
        _refuse(context, sha256, attempt, timeout("IMPORT_TIMEOUT", context.settings.import_timeout_s))
    except Exception as error:
        if are_files_away(error):
            raise
        _refuse(context, sha256, attempt, fault(error, f"import {sha256} attempt {attempt}"))
    else:
        until = None if field.is_recording else context.originals.kept_until(None)
        views: dict[str, Any] = {"views": "none"} if field.is_recording else {}
        if until is None:
            delete_upload(context.blobs, field)
        retry_until_available(
            f"the record of import {sha256}",
            lambda: _end(context, sha256, attempt, state="ready", report=report, original_until=until, **views),
        )


def _refuse(
    context: Context, sha256: str, attempt: int, error: dict[str, Any], asked: Sequence[Candidate] = ()
) -> None:
    retry_until_available(f"the record of import {sha256}", lambda: reject(context, sha256, attempt, error, asked))


def reject(context: Context, sha256: str, attempt: int, error: dict[str, Any], asked: Sequence[Candidate] = ()) -> None:
    """Drop everything the upload left and say why; an upload that another description may mend stays for a while.

    asked: what the upload may be; the pictures of it stay for as long. Does nothing to a field that has moved on.
    """
    field = context.records.get_field(sha256)
    if field is not None and field.attempt == attempt and field.state == "validating":
        if asked:
            error = error | {CANDIDATES: [{"name": one.name, "description": dict(one.description)} for one in asked]}
        context.records.remember_rejection(field, error)
        until = context.originals.kept_until(error.get("reason"))
        if until is None:
            context.blobs.delete_prefix(f"fields/{sha256}")
        else:
            delete_all_but_upload(context.blobs, field)
            for number, one in enumerate(asked, 1):
                if one.picture is not None:
                    context.blobs.put(candidate_key(sha256, number), one.picture)
                    error[CANDIDATES][number - 1]["picture"] = True
        _end(context, sha256, attempt, state="rejected", error=error, original_until=until)


def _end(context: Context, sha256: str, attempt: int, **changes: Any) -> None:
    try:
        context.records.update_field(sha256, attempt=attempt, **changes)
    except StaleAttemptError as error:
        _retire(context, sha256, attempt, error)
    else:
        logger.info("import %s attempt %d ended: %s", sha256, attempt, changes["state"])


def _retire(context: Context, sha256: str, attempt: int, error: StaleAttemptError) -> None:
    logger.info("import %s attempt %d is not current: %s", sha256, attempt, error)
    if context.records.get_field(sha256) is None:
        context.blobs.delete_prefix(f"fields/{sha256}")  # deleted while it was being imported


def _earlier_report(context: Context, field: FieldRecord) -> dict[str, Any] | None:
    """The report of an earlier attempt that died before it wrote the record, if its description was the same."""
    try:
        with context.blobs.open(_report(field.sha256)) as file:
            stored: dict[str, Any] = json.load(file)
    except FileNotFoundError:
        return None
    report: dict[str, Any] = stored["report"]
    return report if stored["description"] == field.description else None


def _report(sha256: str) -> str:
    return f"fields/{sha256}/report.json"


def _work(context: Context, field: FieldRecord, importer: Importer) -> dict[str, Any]:
    """Import the upload. Raises StaleAttemptError, nothing stored, when the field was deleted in between."""
    sha256, description = field.sha256, field.description
    with TemporaryDirectory(prefix="import-") as temporary, context.blobs.local_copy(original_key(sha256)) as upload:
        folder = Path(temporary)
        with _beside(context, field, field.settings) as settings, _beside(context, field, field.cameras) as cameras:
            report: dict[str, Any] = importer(upload, folder, field.said, settings, cameras)
        if "after" in field.description:
            report = _joined(context, field, report, folder)
        if field.is_recording:
            report = {**report, "field_bytes": (folder / "field.safetensors").stat().st_size}
        _require_current(context, field)
        delete_all_but_upload(context.blobs, field)  # an object's model, of what the field was before
        with (folder / "field.safetensors").open("rb") as source, context.blobs.writer() as writer:
            shutil.copyfileobj(source, writer, 1 << 20)
            writer.commit(f"fields/{sha256}/field.safetensors")
    context.blobs.put(_report(sha256), json.dumps({"description": description, "report": report}).encode())
    return report


def _joined(context: Context, field: FieldRecord, report: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Put the frame behind those of the recording that it is added to; what is known of both. Raises DatasetError."""
    from regnf_worker.recorded import joined_recordings, joined_reports

    before, name = reference_of(field.owner, field.description["after"]), str(field.description["frame"])
    known, made = context.records.get_field(before), folder / "field.safetensors"
    if known is None or known.state != "ready":
        raise DatasetError("the recording that the frame was added to was deleted", reason="FIELD_NOT_FOUND")
    with context.blobs.local_copy(view_key(before, made.name)) as first:
        joined_recordings(first, made, name, made)
    return joined_reports(known.report, report, name)


@contextmanager
def _beside(context: Context, field: FieldRecord, came: SettingsFile | None) -> Iterator[Path | None]:
    """What came with the upload, in a file of its own name; None where nothing came."""
    if came is None:
        yield None
        return
    key = settings_key(field.sha256, came.sha256)
    with TemporaryDirectory(prefix="beside-") as temporary, context.blobs.open(key) as stored:
        named = Path(temporary) / came.name
        with named.open("wb") as file:
            shutil.copyfileobj(stored, file)
        yield named


def _require_current(context: Context, field: FieldRecord) -> None:
    """Somebody may have deleted the field, and uploaded it again: what lies there now is no longer ours to touch."""
    now = context.records.get_field(field.sha256)
    if now is None or now.attempt != field.attempt or now.state != "validating":
        raise StaleAttemptError("the field was deleted, or is imported again")

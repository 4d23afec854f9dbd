"""One attempt at a registration job, from its claim to its end."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from redis.exceptions import RedisError

from regnf_core.errors import CancelledError, InvalidInputError, NoSurfaceError, RegnfError
from regnf_core.field_notes import FieldNotes
from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.logs import log_context
from regnf_state.manifest import Manifest, read_manifest
from regnf_state.ownership import sha256_of
from regnf_state.problems import problem_document
from regnf_state.records import FieldRecord, JobRecord, StaleAttemptError, UnreadableRecordError
from regnf_state.registration_request import RegistrationRequest
from regnf_worker.artifacts import discard, discard_others, publish, store_artifacts, verdict_of
from regnf_worker.context import Context
from regnf_worker.engine import Candidate, RegistrationEngine
from regnf_worker.field_notes import warned_of
from regnf_worker.fields import Fields, FieldsNotReadyError
from regnf_worker.heartbeat import Heartbeat
from regnf_worker.job_limits import JobLimits, held_memory_limit, open_reserve
from regnf_worker.models import ObjectModels
from regnf_worker.problems import are_files_away, fault, new_incident
from regnf_worker.retry import retry_until_available

logger = logging.getLogger(__name__)


def run_attempt(
    context: Context, job_id: str, attempt: int, worker: str, make_engine: Callable[[], RegistrationEngine]
) -> None:
    """Claim the attempt, do its work with the engine, write down how it ended.

    Does nothing when the attempt is not to be had: claimed already, cancelled, or an older one. Writes that Redis
    refuses for a while are waited for, until the job's time is over. Raises RedisError, StorageUnavailableError and
    OSError when the end cannot be written down, or a volume is away; the worker's parent process then sees to it.
    """
    try:
        record = _update(context, job_id, attempt, status="running", phase="loading", worker=worker)
    except StaleAttemptError as error:
        logger.info("job %s attempt %d is not run: %s", job_id, attempt, error)
        return
    with log_context(job_id=job_id, attempt=attempt, caller=record.owner):
        _run(context, record, make_engine)


def _run(context: Context, record: JobRecord, make_engine: Callable[[], RegistrationEngine]) -> None:
    job_id, attempt = record.id, record.attempt
    logger.info("job %s attempt %d runs", job_id, attempt)
    with Heartbeat(context.records, job_id, attempt, context.settings.heartbeat_s) as heartbeat:
        try:
            manifest = read_manifest(context.blobs, job_id) or _work(context, record, make_engine, heartbeat)
        except (CancelledError, StaleAttemptError):
            discard(context.blobs, job_id, attempt)
            _end(context, job_id, attempt, status="dismissed")
        except FieldsNotReadyError:
            _give_back(context, job_id, attempt)
        except (RedisError, StorageUnavailableError):
            raise
        except UnreadableRecordError as error:
            logger.error("job %s attempt %d failed: %s", job_id, attempt, error)
            _fail(context, job_id, attempt, problem_document(error.reason))
        except RegnfError as error:
            _fail(context, job_id, attempt, problem_document(error.reason, str(error), hint=error.hint))
        except Exception as error:
            if are_files_away(error):
                raise
            open_reserve()
            incident = new_incident()
            logger.exception("job %s attempt %d failed, incident %s", job_id, attempt, incident)
            _fail(context, job_id, attempt, fault(error, incident, _limits_held(context)))
        else:
            _end(context, job_id, attempt, status="successful", verdict=verdict_of(context.blobs, manifest))
            discard_others(context.blobs, manifest)


def _limits_held(context: Context) -> JobLimits | None:
    """The job's limits, where they hold for this process."""
    return JobLimits.of(context.settings) if held_memory_limit() is not None else None


def _update(context: Context, job_id: str, attempt: int, **changes: Any) -> JobRecord:
    return retry_until_available(
        f"the record of job {job_id}", lambda: context.records.update_job(job_id, attempt, **changes)
    )


def _end(context: Context, job_id: str, attempt: int, **changes: Any) -> None:
    try:
        _update(context, job_id, attempt, **changes)
    except StaleAttemptError as error:
        logger.info("job %s attempt %d is no longer current: %s", job_id, attempt, error)
    else:
        logger.info("job %s attempt %d ended: %s", job_id, attempt, changes["status"])


def _fail(context: Context, job_id: str, attempt: int, error: dict[str, Any]) -> None:
    discard(context.blobs, job_id, attempt)
    _end(context, job_id, attempt, status="failed", error=error)


def _give_back(context: Context, job_id: str, attempt: int) -> None:
    with suppress(StaleAttemptError):
        again = retry_until_available(
            f"the record of job {job_id}", lambda: context.records.requeue_job(job_id, attempt, lost=False)
        )
        context.queue.enqueue_registration(job_id, again.attempt, again.owner)
        logger.info("job %s attempt %d given back: its fields are still being imported", job_id, attempt)


def _work(
    context: Context, record: JobRecord, make_engine: Callable[[], RegistrationEngine], heartbeat: Heartbeat
) -> Manifest:
    """Do the job and publish its result. Returns the manifest that counts, of this attempt or an earlier one."""
    request = RegistrationRequest.from_record(record.request)
    with ExitStack() as stack:
        fields = Fields(context, heartbeat, stack)
        scene = fields.ready(request.scene)
        objects = [fields.ready(sha256) for sha256 in request.objects]
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="job-")))
        engine = make_engine()
        inputs = record.inputs | warned_of(scene, objects)
        _update(context, record.id, record.attempt, engine=engine.describe(), inputs=inputs)
        names = _register(context, engine, request, fields, scene, objects, heartbeat, folder)
        heartbeat.confirm()
        manifest = store_artifacts(context.blobs, record.id, record.attempt, folder, names)
    heartbeat.confirm()
    if publish(context.blobs, manifest):
        return manifest
    published = read_manifest(context.blobs, record.id)
    assert published is not None, "a manifest is never deleted while its job runs"
    return published


def _register(
    context: Context,
    engine: RegistrationEngine,
    request: RegistrationRequest,
    fields: Fields,
    scene: FieldRecord,
    objects: Sequence[FieldRecord],
    heartbeat: Heartbeat,
    folder: Path,
) -> list[str]:
    """Have the engine do what the request asks for; the names of the artifacts in ``folder``."""
    options, scene_file = request.options, fields.file(scene.sha256)
    notes = {sha256_of(one.sha256): FieldNotes.of_report(one.report) for one in objects}
    notes["scene"] = FieldNotes.of_report(scene.report)
    if request.candidates is not None:
        models = ObjectModels(context, engine, options, folder)
        candidates = [_candidate(models, one, fields, heartbeat) for one in objects]
        if all(one.model is None for one in candidates):
            raise NoSurfaceError("none of the candidates is usable as an object", reason="NO_SURFACE_IN_OBJECT")
        return engine.search(scene_file, candidates, request, heartbeat.report, folder, notes)
    (one,) = objects
    object_file, model = fields.file(one.sha256), None
    if options.preset == "robust":
        model = ObjectModels(context, engine, options, folder).of(one, lambda: object_file)
    named = replace(request, object=sha256_of(one.sha256))
    return engine.register(scene_file, object_file, model, named, heartbeat.report, folder, notes)


def _candidate(models: ObjectModels, field: FieldRecord, fields: Fields, heartbeat: Heartbeat) -> Candidate:
    """One candidate with its model; one that is no object is unusable, not the end of the search."""
    heartbeat.report("loading", 0.0)
    sha256 = field.sha256
    try:
        model = models.of(field, lambda: fields.file(sha256))
    except (NoSurfaceError, InvalidInputError) as error:
        return Candidate(sha256_of(sha256), lambda: fields.file(sha256), None, error.reason)
    return Candidate(sha256_of(sha256), lambda: fields.file(sha256), model)

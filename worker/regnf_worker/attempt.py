"""One attempt at a job, whatever its kind, from its claim to its end."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from redis.exceptions import RedisError
from rq.timeouts import JobTimeoutException

from regnf_core.errors import CancelledError, RegnfError
from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.job_request import request_of
from regnf_state.logs import log_context
from regnf_state.manifest import Manifest, read_manifest
from regnf_state.problems import problem_document
from regnf_state.records import JobRecord, StaleAttemptError, UnreadableRecordError
from regnf_state.rendering_request import RenderingRequest
from regnf_worker.artifacts import discard, discard_others, publish, store_artifacts, told_by_result
from regnf_worker.context import Context
from regnf_worker.edited_fields import keep_edited_field
from regnf_worker.engine import Engine, Made
from regnf_worker.field_notes import warned_of
from regnf_worker.fields import Fields, FieldsNotReadyError
from regnf_worker.heartbeat import Heartbeat
from regnf_worker.job_limits import JobLimits, held_memory_limit, open_reserve
from regnf_worker.kernel import give_way
from regnf_worker.problems import are_files_away, fault, new_incident, refusal, timeout
from regnf_worker.registration import register
from regnf_worker.rendering import render
from regnf_worker.rest import Published, finish_result
from regnf_worker.retry import retry_until_available
from regnf_worker.worker_pipe import let_worker_go

logger = logging.getLogger(__name__)


def run_attempt(context: Context, job_id: str, attempt: int, worker: str, make_engine: Callable[[], Engine]) -> None:
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


def _run(context: Context, record: JobRecord, make_engine: Callable[[], Engine]) -> None:
    logger.info("job %s attempt %d runs", record.id, record.attempt)
    with ExitStack() as stack:
        with Heartbeat(context.records, record.id, record.attempt, context.settings.heartbeat_s) as heartbeat:
            done = _published(context, record, make_engine, heartbeat, stack)
        if done is not None and done.manifest.pending:
            if let_worker_go():
                give_way(context.settings.job_niceness)
            finish_result(context, record, done)


def _published(
    context: Context, record: JobRecord, make_engine: Callable[[], Engine], heartbeat: Heartbeat, stack: ExitStack
) -> Published | None:
    """Do the work, publish its result, and end the record; None when the job has ended without a result.

    What is opened on ``stack`` is needed until the rest of the result is there.
    """
    job_id, attempt = record.id, record.attempt
    try:
        known = read_manifest(context.blobs, job_id)
        done = Published(known) if known is not None else _work(context, record, make_engine, heartbeat, stack)
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
        _fail(context, job_id, attempt, refusal(error))
    except JobTimeoutException:
        _fail(context, job_id, attempt, timeout("JOB_TIMEOUT", context.settings.job_timeout_s))
    except Exception as error:
        if are_files_away(error):
            raise
        open_reserve()
        incident = new_incident()
        logger.exception("job %s attempt %d failed, incident %s", job_id, attempt, incident)
        _fail(context, job_id, attempt, fault(error, incident, _limits_held(context)))
    else:
        keep_edited_field(context, record.owner, done.manifest)
        _end(context, job_id, attempt, status="successful", **told_by_result(context.blobs, done.manifest))
        discard_others(context.blobs, done.manifest)
        return done
    return None


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
        context.queue.enqueue_registration(job_id, again.attempt, again.owner, again.is_of_batch)
        logger.info("job %s attempt %d given back: its fields are still being imported", job_id, attempt)


def _work(
    context: Context, record: JobRecord, make_engine: Callable[[], Engine], heartbeat: Heartbeat, stack: ExitStack
) -> Published:
    """Do the job and publish its result: the one that counts, of this attempt or an earlier one."""
    request = request_of(record)
    fields = Fields(context, heartbeat, stack)
    scene, *objects = fields.ready([request.scene, *request.objects])
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="job-")))
    engine = make_engine()
    inputs = record.inputs | warned_of(scene, objects)
    _update(context, record.id, record.attempt, engine=engine.describe(), inputs=inputs)
    if isinstance(request, RenderingRequest):
        made = Made(render(engine, request.rendering, fields, scene, objects, heartbeat, folder))
    else:
        made = register(context, engine, request, fields, scene, objects, heartbeat, folder)
    heartbeat.confirm()
    stored = store_artifacts(context.blobs, record.id, record.attempt, folder, made.names)
    manifest = Manifest(record.id, record.attempt, stored, tuple(made.to_come))
    heartbeat.confirm()
    if publish(context.blobs, manifest):
        return Published(manifest, made, folder)
    published = read_manifest(context.blobs, record.id)
    assert published is not None, "a manifest is never deleted while its job runs"
    return Published(published)

"""One attempt at a registration job, from its claim to its end."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from redis.exceptions import RedisError

from regnf_core.errors import CancelledError, InvalidInputError, RegnfError
from service.records import FieldRecord, JobRecord, StaleAttemptError
from worker.artifacts import Manifest, discard, discard_others, publish, read_manifest, store_artifacts
from worker.context import Context
from worker.engine import RegistrationEngine
from worker.patience import patiently
from worker.problems import fault, new_incident, problem
from worker.pulse import Pulse

_FIELD_POLL_S = 0.2
_WAIT_BEFORE_GIVING_BACK_S = 20.0
logger = logging.getLogger(__name__)


class FieldsNotReadyError(Exception):
    """A field is still being imported; whoever waits longer should let somebody else use the worker."""


def run_attempt(
    context: Context, job_id: str, attempt: int, worker: str, make_engine: Callable[[], RegistrationEngine]
) -> None:
    """Claim the attempt, do its work with the engine, write down how it ended.

    Does nothing when the attempt is not to be had: claimed already, cancelled, or an older one. Writes that Redis
    refuses for a while are waited for, until the job's time is over. Raises RedisError and OSError of the network kind
    when the end cannot be written down; the worker's parent process then sees to it.
    """
    try:
        record = _update(context, job_id, attempt, status="running", phase="loading", worker=worker)
    except StaleAttemptError as error:
        logger.info("job %s attempt %d is not run: %s", job_id, attempt, error)
        return
    logger.info("job %s attempt %d runs", job_id, attempt)
    with Pulse(context.records, job_id, attempt, context.settings.heartbeat_s) as pulse:
        try:
            manifest = read_manifest(context.blobs, job_id) or _work(context, record, make_engine, pulse)
        except (CancelledError, StaleAttemptError):
            discard(context.blobs, job_id, attempt)
            _end(context, job_id, attempt, status="dismissed")
        except FieldsNotReadyError:
            _give_back(context, job_id, attempt)
        except RedisError:
            raise
        except RegnfError as error:
            _fail(context, job_id, attempt, problem(error.reason, str(error)))
        except Exception as error:
            incident = new_incident()
            logger.exception("job %s attempt %d failed, incident %s", job_id, attempt, incident)
            _fail(context, job_id, attempt, fault(error, incident))
        else:
            _end(context, job_id, attempt, status="successful")
            discard_others(context.blobs, job_id, manifest)


def _update(context: Context, job_id: str, attempt: int, **changes: Any) -> JobRecord:
    return patiently(f"the record of job {job_id}", lambda: context.records.update_job(job_id, attempt, **changes))


def _end(context: Context, job_id: str, attempt: int, **changes: Any) -> None:
    try:
        _update(context, job_id, attempt, **changes)
    except StaleAttemptError as error:
        logger.info("job %s attempt %d has no say any more: %s", job_id, attempt, error)
    else:
        logger.info("job %s attempt %d ended: %s", job_id, attempt, changes["status"])


def _fail(context: Context, job_id: str, attempt: int, error: dict[str, Any]) -> None:
    discard(context.blobs, job_id, attempt)
    _end(context, job_id, attempt, status="failed", error=error)


def _give_back(context: Context, job_id: str, attempt: int) -> None:
    with suppress(StaleAttemptError):
        again = patiently(
            f"the record of job {job_id}", lambda: context.records.requeue_job(job_id, attempt, lost=False)
        )
        context.queue.enqueue_registration(job_id, again.attempt)
        logger.info("job %s attempt %d given back: its fields are still being imported", job_id, attempt)


def _work(context: Context, record: JobRecord, make_engine: Callable[[], RegistrationEngine], pulse: Pulse) -> Manifest:
    """The job's result, standing. Raises whatever kept it from standing."""
    request = record.request
    with ExitStack() as stack:
        scene, object_ = (stack.enter_context(_field(context, request[name], pulse)) for name in ("scene", "object"))
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="job-")))
        engine = make_engine()
        _update(context, record.id, record.attempt, engine=engine.describe())
        names = engine.register(scene, object_, request, pulse.report, folder)
        pulse.confirm()
        manifest = store_artifacts(context.blobs, record.id, record.attempt, folder, names)
    pulse.confirm()
    if publish(context.blobs, record.id, manifest):
        return manifest
    standing = read_manifest(context.blobs, record.id)
    assert standing is not None, "a manifest is never taken back while its job runs"
    return standing


@contextmanager
def _field(context: Context, sha256: str, pulse: Pulse) -> Iterator[Path]:
    """The safe field file, once its import has ended.

    Raises InvalidInputError (FIELD_NOT_FOUND, FIELD_REJECTED, FIELD_IMPORT_TIMEOUT), FieldsNotReadyError.
    """
    deadline = time.monotonic() + _WAIT_BEFORE_GIVING_BACK_S
    while (field := _usable(context, sha256)).state == "validating":
        pulse.check()
        if time.monotonic() > deadline:
            raise FieldsNotReadyError(sha256)
        time.sleep(_FIELD_POLL_S)
    with context.blobs.local_copy(f"fields/{field.sha256}/field.safetensors") as path:
        yield path


def _usable(context: Context, sha256: str) -> FieldRecord:
    field = context.records.get_field(sha256)
    if field is None:
        raise InvalidInputError(f"field {sha256} was deleted", reason="FIELD_NOT_FOUND")
    if field.state == "rejected":
        why = (field.error or {}).get("reason", "unknown")
        raise InvalidInputError(f"field {sha256} was rejected: {why}", reason="FIELD_REJECTED")
    settings = context.settings
    longest = 2 * (settings.import_timeout_s + settings.lost_after_s)
    if field.state == "validating" and context.records.now() - field.updated > longest:
        raise InvalidInputError(f"field {sha256} was not imported in time", reason="FIELD_IMPORT_TIMEOUT")
    return field

"""One attempt at a job, whatever its kind, from its claim to its end."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

from redis.exceptions import RedisError
from rq.timeouts import JobTimeoutException

from regnf_core.errors import CancelledError, InvalidInputError, NoSurfaceError, RegnfError
from regnf_core.field_notes import FieldNotes
from regnf_state.blobs.base import StorageUnavailableError
from regnf_state.logs import log_context
from regnf_state.manifest import Manifest, read_manifest
from regnf_state.ownership import sha256_of
from regnf_state.reasons import problem_document
from regnf_state.records import WARNINGS, FieldRecord, JobRecord, StaleAttemptError, UnreadableRecordError
from regnf_state.redis.jobs import RecordStore
from regnf_state.registration_request import RegistrationRequest, RenderingRequest, request_of
from regnf_worker.artifacts import discard, discard_others, keep_edited_field, publish, store_artifacts, told_by_result
from regnf_worker.engine import Candidate, Engine, Made
from regnf_worker.job_limits import (
    JobLimits,
    are_files_away,
    fault,
    held_memory_limit,
    open_reserve,
    refusal,
    timeout,
)
from regnf_worker.models import Context, ObjectModels
from regnf_worker.pictures import Published, finish_result, let_worker_go
from regnf_worker.resilient_worker import retry_until_available

# What a job repeats of its fields' imports: in its result all of it, in its record the words of the warnings.

_MOST_WORDS = 16
_WORD_LENGTH = 64


def warned_of(scene: FieldRecord, objects: Sequence[FieldRecord]) -> dict[str, Any]:
    """An entry of a job's inputs: the words of the warnings of its scene, and of its object if it has one alone."""
    named = {"scene": scene} | ({"object": objects[0]} if len(objects) == 1 else {})
    words = {
        name: [word[:_WORD_LENGTH] for word in FieldNotes.of_report(one.report).words[:_MOST_WORDS]]
        for name, one in named.items()
    }
    found = {name: list(dict.fromkeys(said)) for name, said in words.items() if said}
    return {WARNINGS: found} if found else {}


# A job's heartbeat, which also tells the job when it must stop.

STOP_WITHIN_S = 5.0
_REPORT_EVERY_S = 0.25
_LAST_WORD_S = 1.0
"""A heartbeat that is on its way when the job ends has this long to arrive."""


class Heartbeat:
    """Beats in a thread of its own while the job runs, and writes the job's progress to its record.

    Use as a context manager. ``report`` is the registration's progress callback: it raises CancelledError once the job
    was canceled or another attempt has taken over (``superseded``). A job that does not come back to ``report`` within
    five seconds of that is killed: native code receives no exception.
    """

    def __init__(self, records: RecordStore, job_id: str, attempt: int, beat_s: float) -> None:
        self._records = records
        self._job_id = job_id
        self._attempt = attempt
        self._beat_s = beat_s
        self._ended = threading.Event()
        self._stop = threading.Event()
        self._phase: str | None = None
        self._reported = 0.0
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self.superseded = False

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join(_LAST_WORD_S)

    def report(self, phase: str, progress: float) -> None:
        """Note phase and overall progress 0..1: every change of phase, the rest a few times a second."""
        self.check()
        now = time.monotonic()
        if phase == self._phase and now - self._reported < _REPORT_EVERY_S:
            return
        self._phase, self._reported = phase, now
        self._ask(lambda: self._records.update_job(self._job_id, self._attempt, phase=phase, progress=progress))
        self.check()

    def check(self) -> None:
        """Raises CancelledError when the job shall stop."""
        if self._stop.is_set():
            raise CancelledError("the job was canceled" if not self.superseded else "another attempt has taken over")

    def confirm(self) -> None:
        """Ask the record, as soon as it answers, whether this attempt counts. Raises CancelledError, RedisError."""
        retry_until_available(
            f"the record of job {self._job_id}",
            lambda: self._note(self._records.heartbeat, self._job_id, self._attempt),
        )
        self.check()

    def _beat(self) -> None:
        while not self._ended.wait(self._beat_s):
            self._ask(lambda: self._records.heartbeat(self._job_id, self._attempt))
            if self._stop.is_set():
                if not self._ended.wait(STOP_WITHIN_S):
                    logger.warning("job %s attempt %d did not stop and was killed", self._job_id, self._attempt)
                    os.kill(os.getpid(), signal.SIGKILL)
                return

    def _ask(self, change: Any) -> None:
        try:
            self._note(change)
        except RedisError as error:
            logger.warning("job %s attempt %d: Redis does not answer: %s", self._job_id, self._attempt, error)
        except MemoryError:
            logger.warning("job %s attempt %d: there is no memory left for a heartbeat", self._job_id, self._attempt)

    def _note(self, change: Any, *arguments: Any) -> None:
        try:
            record: JobRecord = change(*arguments)
        except StaleAttemptError:
            self.superseded = True
            self._stop.set()
        else:
            if record.cancel_requested:
                self._stop.set()


# The fields that a job reads, as files for as long as the job runs.


class FieldsNotReadyError(Exception):
    """A field is still being imported; the job goes back to the queue, where it waits for that."""


class Fields:
    """Fields of one job. Whatever is opened stays open until ``stack`` closes."""

    def __init__(self, context: Context, stack: ExitStack) -> None:
        self._context = context
        self._stack = stack

    def ready(self, references: Sequence[str]) -> list[FieldRecord]:
        """The fields' records.

        Raises InvalidInputError (FIELD_NOT_FOUND, FIELD_REJECTED, FIELD_IMPORT_TIMEOUT), FieldsNotReadyError.
        """
        found = self._context.records.get_fields(references)
        fields = [self._checked(field, sha256_of(name)) for field, name in zip(found, references, strict=True)]
        if any(field.state == "validating" for field in fields):
            raise FieldsNotReadyError
        return fields

    def file(self, sha256: str) -> Path:
        """The regnf field file of a field that is ready."""
        return self._stack.enter_context(self._context.blobs.local_copy(f"fields/{sha256}/field.safetensors"))

    def _checked(self, field: FieldRecord | None, name: str) -> FieldRecord:
        if field is None:
            raise InvalidInputError(f"field {name} was deleted", reason="FIELD_NOT_FOUND")
        if field.state == "rejected":
            why = field.error or {}
            message = f"field {name} was rejected: {why.get('reason', 'unknown')}: {why.get('detail', '')}"
            raise InvalidInputError(message.rstrip(": "), reason="FIELD_REJECTED", hint=why.get("hint"))
        settings = self._context.settings
        longest = 2 * (settings.import_timeout_s + settings.lost_after_s)
        if field.state == "validating" and self._context.records.now() - field.updated > longest:
            message = f"field {name} was not imported within {longest:g} s (twice REGNF_IMPORT_TIMEOUT_S and more)"
            raise InvalidInputError(message, reason="FIELD_IMPORT_TIMEOUT")
        return field


# The work of a registration job: models of its objects, then the engine.


def register(
    context: Context,
    engine: Engine,
    request: RegistrationRequest,
    fields: Fields,
    scene: FieldRecord,
    objects: Sequence[FieldRecord],
    heartbeat: Heartbeat,
    folder: Path,
) -> Made:
    """Have the engine do what the request asks for, artifacts into ``folder``."""
    options, scene_file = request.options, fields.file(scene.sha256)
    notes = {sha256_of(one.sha256): FieldNotes.of_report(one.report) for one in objects}
    notes["scene"] = FieldNotes.of_report(scene.report)
    if request.candidates is not None:
        models = ObjectModels(context, engine, options, folder)
        candidates = [_candidate(models, one, fields, heartbeat) for one in objects]
        if all(one.model is None for one in candidates):
            raise NoSurfaceError("no candidate is usable as an object", reason="NO_SURFACE_IN_OBJECT")
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


logger = logging.getLogger(__name__)


def run_attempt(context: Context, job_id: str, attempt: int, worker: str, make_engine: Callable[[], Engine]) -> None:
    """Claim the attempt, do its work with the engine, write down how it ended.

    Does nothing when the attempt is not to be had: claimed already, canceled, or an older one. Writes that Redis
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
            let_worker_go()
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
        limits = JobLimits.of(context.settings) if held_memory_limit() is not None else None
        _fail(context, job_id, attempt, fault(error, f"job {job_id} attempt {attempt}", limits))
    else:
        keep_edited_field(context, record.owner, done.manifest)
        _end(context, job_id, attempt, status="successful", **told_by_result(context.blobs, done.manifest))
        discard_others(context.blobs, done.manifest)
        return done
    return None


def _update(context: Context, job_id: str, attempt: int, **changes: Any) -> JobRecord:
    return retry_until_available(
        f"the record of job {job_id}", lambda: context.records.update_job(job_id, attempt, **changes)
    )


def _end(context: Context, job_id: str, attempt: int, **changes: Any) -> None:
    try:
        _update(context, job_id, attempt, **changes)
    except StaleAttemptError as error:
        logger.info("job %s attempt %d is not current: %s", job_id, attempt, error)
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
        logger.info("job %s attempt %d put back into the queue: its fields are still being imported", job_id, attempt)


def _work(
    context: Context, record: JobRecord, make_engine: Callable[[], Engine], heartbeat: Heartbeat, stack: ExitStack
) -> Published:
    request = request_of(record)
    fields = Fields(context, stack)
    scene, *objects = fields.ready([request.scene, *request.objects])
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="job-")))
    engine = make_engine()
    inputs = record.inputs | warned_of(scene, objects)
    _update(context, record.id, record.attempt, engine=engine.describe(), inputs=inputs)
    if isinstance(request, RenderingRequest):
        opened = {sha256_of(one.sha256): partial(fields.file, one.sha256) for one in objects}
        place = fields.file(scene.sha256)
        made = Made(engine.render(place, opened, request.rendering, heartbeat.report, folder))
    else:
        made = register(context, engine, request, fields, scene, objects, heartbeat, folder)
    heartbeat.confirm()
    stored = store_artifacts(context.blobs, record.id, record.attempt, folder, made.names)
    later = {"pending": tuple(made.to_come), "on_request": tuple(made.on_request)}
    manifest = Manifest(record.id, record.attempt, stored, **later)
    heartbeat.confirm()
    if publish(context.blobs, manifest):
        return Published(manifest, made, folder)
    published = read_manifest(context.blobs, record.id)
    assert published is not None, "a manifest is never deleted while its job runs"
    return Published(published)

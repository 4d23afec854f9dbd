"""Batches: lines that are posted together become jobs together, and their jobs tell how far the batch is.

A batch is nothing but jobs with a common id, in their caller's own line. Nothing runs in the background for it.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from regnf_core.pairs import short_result
from regnf_service.concurrency import portions
from regnf_service.fields.ingest import room_for_bytes
from regnf_service.jobs.edits import manifest_of, result_of
from regnf_service.jobs.submit import FieldLookup, check_fields, future_job_id, start
from regnf_service.problem import RETRY_LATER, Problem
from regnf_service.services import Services
from regnf_state.batches import Batch, Pair
from regnf_state.reasons import problem_document, whole_problem
from regnf_state.records import ACTIVE, JobRecord, QuotaError, RecordError, UnreadableRecordError
from regnf_state.registration_request import RegistrationRequest

COUNTED = ("registered", "ambiguous", "rejected", "failed", "refused")
"""How a pair can end: a verdict, an error of its job, or an error of its line."""
_BATCH_ID = re.compile(r"[0-9a-f]{32}")
_AT_ONCE = 100
_NAMES_AT_ONCE = 2000
"""That the lines have which are checked or started together: a megabyte of records of searches."""
_LOOKED_AT = 500
_PAGE_BYTES = 1 << 20
"""Of a page of results: pairs that it is chosen from, and bytes."""
_Held = JobRecord | UnreadableRecordError | None


# posting


@dataclass
class Line:
    """A line while its batch is posted. number: in the body, from 1 on · named: the fields that the caller must have,
    by where the line names them · error: why it becomes no job · is_new: whether its job is yet to be started ·
    is_done: whether there is nothing to start."""

    number: int
    key: str | None = None
    asked: RegistrationRequest | None = None
    named: Mapping[str, str] = field(default_factory=dict)
    error: dict[str, Any] | None = None
    job: str | None = None
    is_new: bool = False
    is_done: bool = False


class Posting:
    """Makes jobs of the lines of one batch. Call ``check`` for all of them, then ``require_room``, then ``submit`` for
    all of them, then ``keep``. A process that dies in between leaves jobs that the same lines find again."""

    def __init__(self, services: Services, caller: str, batch_id: str, lines: Sequence[Line]) -> None:
        self._services = services
        self._caller = caller
        self._batch_id = batch_id
        self.lines = lines
        self._fields = FieldLookup(services, caller)

    def portions(self) -> Iterator[Sequence[Line]]:
        """A few lines at a time."""
        return portions(self.lines, lambda line: 1 + len(_fields_of(line)), _NAMES_AT_ONCE, _AT_ONCE)

    def check(self, lines: Sequence[Line]) -> None:
        """Refuse what POST /register would refuse, and find out which jobs there are."""
        services, caller = self._services, self._caller
        fields: FieldLookup | None = self._fields
        try:
            self._fields.read(name for line in lines for name in _fields_of(line))
        except UnreadableRecordError:
            fields = None  # each line reads its own: those that name the damaged one are refused, and no other
        for line in lines:
            if line.asked is None:
                continue
            try:
                check_fields(services, caller, line.asked, line.named, fields)
                line.job = future_job_id(services, caller, line.asked, fields)
            except Problem as problem:
                line.error = problem.document()
            except UnreadableRecordError as error:
                line.error = problem_document(error.reason)
        held = jobs_of(services, [line.job for line in lines if line.job is not None])
        for line in lines:
            if line.job is None:
                continue
            known = held[line.job]
            status = known.status if isinstance(known, JobRecord) else None
            line.is_new = status in (None, "failed", "dismissed")
            is_told = line.asked is None or line.asked.webhook is None
            line.is_done = is_told and status in ("running", "successful")

    def require_room(self) -> None:
        """Raises Problem QUOTA_ACTIVE_JOBS, QUOTA_STORED, QUEUE_FULL.

        Then nothing is started.
        """
        services, caller = self._services, self._caller
        self._require_batches()
        new = {line.job for line in self.lines if line.is_new}
        if not new:
            return
        free, reason = services.records.room_for_jobs(caller, services.settings.max_queued_jobs, services.quota)
        if len(new) > free:
            detail = f"The lines need {len(new)} new jobs, but only {free} are possible. No job was started."
            fitting = {"new_jobs": len(new), "fitting_lines": self._fitting(free)}
            raise Problem(reason, detail, headers=RETRY_LATER, extra=fitting)

    def _fitting(self, free: int) -> int:
        new: set[str | None] = set()
        for place, line in enumerate(self.lines):
            new |= {line.job} if line.is_new else set()
            if len(new) > free:
                return place
        return len(self.lines)

    def _require_batches(self) -> None:
        services, caller = self._services, self._caller
        kept = [entry for entry in services.batches.kept(caller) if not entry.key.endswith(f"/{self._batch_id}")]
        while len(kept) >= services.settings.quota_batches:
            ended = next((entry for entry in reversed(kept) if not _is_active(services, caller, entry.key)), None)
            if ended is None:
                detail = "You have the maximum number of batches, and none has ended. Wait until one ends."
                raise Problem("QUOTA_ACTIVE_JOBS", detail, headers=RETRY_LATER)
            services.batches.delete(caller, ended.key.rpartition("/")[2])
            kept.remove(ended)
        room = room_for_bytes(services, caller)
        if room is not None and len(self._batch().text()) > room:
            raise Problem("QUOTA_STORED")

    def submit(self, lines: Sequence[Line]) -> None:
        """Start their jobs, as POST /register does. Raises what that raises, where it is not of one line alone."""
        self._services.room.make(self._caller)
        left = [
            (line, line.job, line.asked)
            for line in lines
            if line.asked is not None and line.job is not None and not line.is_done
        ]
        started = start(self._services, self._caller, [(job, asked) for _, job, asked in left], self._batch_id)
        for (line, _, _), answer in zip(left, started, strict=True):
            match answer:
                case UnreadableRecordError(reason=reason) | QuotaError(reason="QUOTA_WEBHOOKS" as reason):
                    line.error, line.job = problem_document(reason), None
                case RecordError():
                    raise answer

    def keep(self) -> Batch:
        """Write the batch down. Raises OSError."""
        batch = self._batch()
        self._services.batches.put(batch)
        return batch

    def _batch(self) -> Batch:
        pairs = tuple(Pair(line.number, line.key, line.job, line.error) for line in self.lines)
        return Batch(self._batch_id, self._caller, self._services.records.now(), pairs)


def _fields_of(line: Line) -> list[str]:
    asked = line.asked
    return [] if asked is None else list(dict.fromkeys((asked.scene, *asked.objects, *line.named.values())))


def _is_active(services: Services, caller: str, key: str) -> bool:
    try:
        batch = services.batches.find(caller, key.rpartition("/")[2])
    except UnreadableRecordError:
        return False
    return batch is not None and bool(services.records.active_among(batch.jobs))


# looking


class BatchState(NamedTuple):
    """How far a batch is. active: pairs whose job waits or runs · is_cancelled: whether jobs of it were."""

    active: int
    counts: Mapping[str, int]
    is_cancelled: bool

    @property
    def status(self) -> str:
        if self.active:
            return "running"
        return "dismissed" if self.is_cancelled else "finished"


def find_batch(services: Services, caller: str, batch_id: str) -> Batch:
    """The caller's own. Raises Problem BATCH_NOT_FOUND, UnreadableRecordError."""
    batch = services.batches.find(caller, batch_id) if _BATCH_ID.fullmatch(batch_id) else None
    if batch is None:
        raise Problem("BATCH_NOT_FOUND")
    return batch


def jobs_of(services: Services, job_ids: Sequence[str]) -> dict[str, _Held]:
    """The jobs of these ids, some at a time; None for one that is gone."""
    found: dict[str, _Held] = {}
    for first in range(0, len(job_ids), _AT_ONCE):
        few = job_ids[first : first + _AT_ONCE]
        found |= dict(zip(few, services.records.get_jobs(few), strict=True))
    return found


def state_of(services: Services, batch: Batch) -> BatchState:
    jobs = jobs_of(services, batch.jobs)
    counts: Counter[str] = Counter()
    active, is_cancelled = 0, False
    for pair in batch.pairs:
        job = jobs[pair.job] if pair.job is not None else None
        if isinstance(job, JobRecord) and (job.cancel_requested or job.status == "dismissed"):
            is_cancelled = True
        if pair.error is not None:
            counts["refused"] += 1
        elif not isinstance(job, JobRecord) or job.status in ("failed", "dismissed"):
            counts["failed"] += 1
        elif job.status in ACTIVE:
            active += 1
        else:
            counts[job.verdict if job.verdict in COUNTED else "failed"] += 1
    return BatchState(active, counts, is_cancelled)


def is_waiting(services: Services, batch: Batch, after: int) -> bool:
    """Whether the pair behind the first ``after`` has not ended."""
    pair = batch.pairs[after] if after < len(batch.pairs) else None
    return pair is not None and pair.job is not None and bool(services.records.active_among([pair.job]))


class ResultsPage(NamedTuple):
    """Results of some pairs, a line each. after: the number of the last pair that was looked at."""

    text: bytes
    after: int


def results_page(services: Services, batch: Batch, after: int, limit: int, status: str | None) -> ResultsPage:
    """Results in the order of the pairs, from the one behind the first ``after`` to the first that has not ended."""
    lines: list[bytes] = []
    size = 0
    for number, pair, job in _ended(services, batch, after):
        if len(lines) >= limit or size >= _PAGE_BYTES:
            break
        if status is None or status in _possible(pair, job):
            told = _result(services, pair, job)
            if status in (None, told["status"]):
                lines.append(json.dumps({"number": number, **told}, separators=(",", ":")).encode() + b"\n")
                size += len(lines[-1])
        after = number
    return ResultsPage(b"".join(lines), after)


def _ended(services: Services, batch: Batch, after: int) -> Iterator[tuple[int, Pair, _Held]]:
    """The pairs behind the first ``after`` with their numbers and jobs, up to the first that has not ended."""
    for first in range(after, min(after + _LOOKED_AT, len(batch.pairs)), _AT_ONCE):
        few = batch.pairs[first : first + _AT_ONCE]
        jobs = jobs_of(services, list(dict.fromkeys(pair.job for pair in few if pair.job is not None)))
        for number, pair in enumerate(few, first + 1):
            job = jobs[pair.job] if pair.job is not None else None
            if isinstance(job, JobRecord) and job.status in ACTIVE:
                return
            yield number, pair, job


def _possible(pair: Pair, job: _Held) -> tuple[str, ...]:
    """How a result may begin, as far as its files need not be read."""
    if pair.error is not None:
        return ("refused",)
    is_successful = isinstance(job, JobRecord) and job.status == "successful"
    return ("successful", "failed") if is_successful else ("failed",)


def _result(services: Services, pair: Pair, job: _Held) -> dict[str, Any]:
    told: dict[str, Any] = {"line": pair.line, "key": pair.key, "job": pair.job}
    if pair.error is not None:
        return told | {"status": "refused", "error": pair.error}
    try:
        if job is None:
            raise Problem("JOB_EXPIRED")
        if isinstance(job, UnreadableRecordError):
            raise job
        result = result_of(services, manifest_of(services, job))
    except Problem as problem:
        of_job = job.error if isinstance(job, JobRecord) and job.status == "failed" else None
        return told | {"status": "failed", "error": whole_problem(of_job) if of_job else problem.document()}
    except UnreadableRecordError as error:
        return told | {"status": "failed", "error": problem_document(error.reason)}
    return told | {"status": "successful", **short_result(result)}


# stopping


def cancel(services: Services, batch: Batch) -> int:
    """Cancel the jobs that the batch has started and that wait or run; how many."""
    cancelled = 0
    for job_id, job in jobs_of(services, sorted(services.records.active_among(batch.jobs))).items():
        if isinstance(job, JobRecord) and job.inputs.get("batch") == batch.id:
            after = services.records.request_cancel(job_id)
            if after is not None and after.status not in ("successful", "failed"):
                services.queue.stop(job_id, after.attempt)
                cancelled += 1
    return cancelled

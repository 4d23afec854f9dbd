"""Finds what has failed silently: jobs without a heartbeat, work that is in no queue, results past their retention.

Every change of a record is fenced by its attempt. What cannot be undone is done only by a leader that has just
confirmed that it still leads.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

from redis import Redis
from redis.exceptions import RedisError

from regnf_service.upkeep.housekeeping import Housekeeper, Lease, LeaseLostError, Term
from regnf_state.blobs.base import BlobStore
from regnf_state.journal.journaled_records import Rebuilder
from regnf_state.reasons import problem_document
from regnf_state.records import FieldRecord, JobRecord, StaleAttemptError
from regnf_state.redis.jobs import RecordStore
from regnf_state.redis.queue import JobQueue
from regnf_state.redis.unreadable import PREFIX
from regnf_state.settings import Settings

# How long records have been unchanged, by this process' monotonic clock, which no step of a clock affects.


class Staleness:
    """Sees every record in every round. When two rounds are more than ``unbroken_s`` apart, all counting begins again.

    A process that could not look, because Redis was away or the machine slept, does not know what changed. Where it
    knows that it could not, it says so with ``forget``.
    """

    def __init__(self, unbroken_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._unbroken_s = unbroken_s
        self._clock = clock
        self._now = clock()
        self._before: dict[str, tuple[Any, float]] = {}
        self._seen: dict[str, tuple[Any, float]] = {}

    def begin_round(self) -> None:
        """Look again; what the round before did not see is forgotten."""
        now = self._clock()
        self._before = self._seen if now - self._now <= self._unbroken_s else {}
        self._now, self._seen = now, {}

    def forget(self) -> None:
        """Redis could not be written to: a record that stayed the same until now tells nothing."""
        self._before, self._seen = {}, {}

    def of(self, name: str, mark: Any) -> float:
        """For how many seconds the record ``name`` has been seen with this very mark."""
        known = self._before.get(name)
        since = known[1] if known is not None and known[0] == mark else self._now
        self._seen[name] = (mark, since)
        return self._now - since


_LEADER_KEY = f"{PREFIX}reaper"
_LEADS_FOR_S = 30
"""If a leader is killed during a round, the others wait for this long."""
_UNHELD_FOR_S = 15.0
"""Work that has been in no queue for this long was lost on its way, or with its worker."""
_MIN_UNBROKEN_S = 30.0
"""Rounds up to twice the usual interval apart count as consecutive, however small ``lost_after_s`` is."""
_IMPORT_RETRIES = 2
_Record = TypeVar("_Record", JobRecord, FieldRecord)
logger = logging.getLogger(__name__)


Done = dict[str, list[str]]
"""What one round did: ids by action, which is requeued, failed, dismissed, enqueued, expired or recalled (a record made
again from the journal)."""


class Reaper:
    """Call ``run_once`` every fifteen seconds or so, from as many processes as like: one at a time does the work."""

    def __init__(
        self,
        records: RecordStore,
        queue: JobQueue,
        redis: Redis,
        settings: Settings,
        blobs: BlobStore | None = None,
        rebuilder: Rebuilder | None = None,
        housekeeper: Housekeeper | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._records = records
        self._queue = queue
        self._lost_after_s = settings.lost_after_s
        self._blobs = blobs
        self._rebuilder = rebuilder
        self._housekeeper = housekeeper
        unbroken = max(settings.lost_after_s / 2, _MIN_UNBROKEN_S)
        self._staleness = Staleness(unbroken_s=unbroken, clock=clock)
        self._lease = Lease(redis, _LEADER_KEY, _LEADS_FOR_S)

    def run_once(self) -> Done:
        """One round; nothing when another process leads. Raises RedisError when Redis cannot be reached."""
        done: Done = defaultdict(list)
        with ExitStack() as stack:
            try:
                # any process that finds Redis emptied rebuilds it: reading the journal takes longer than a term
                rebuilt = None if self._rebuilder is None else self._rebuilder.run_if_needed()
                if rebuilt is not None and (recalled := [*rebuilt.jobs, *rebuilt.fields]):
                    done["recalled"] = recalled
                term = stack.enter_context(self._lease.held())
            except RedisError:  # no worker could write a heartbeat either
                self._staleness.forget()
                raise
            if term is not None:
                try:
                    self._lead(term, done)
                except LeaseLostError as error:
                    logger.warning("the round ends early: %s", error)
        return dict(done)

    def _lead(self, term: Term, done: Done) -> None:
        now = self._records.now()
        self._staleness.begin_round()
        self._mend_queue()
        for job in self._records.active_jobs():
            term.confirm()
            _note(done, job.id, self._look_after_job, job, now)
        for field in self._records.validating_fields():
            term.confirm()
            _note(done, field.sha256, self._look_after_import, field, now)
        term.confirm()
        if expired := self._records.expire_jobs():
            done["expired"] += expired
        if self._blobs is not None:
            for job_id in expired:
                self._blobs.delete_prefix(f"jobs/{job_id}")
        if self._housekeeper is not None:
            self._housekeeper.tidy_records(term)
            self._housekeeper.run_if_due(term)

    def _mend_queue(self) -> None:
        """Do what a process that died may have left undone: hand out what is next, queue what waited for an import."""
        self._queue.turn()
        for reference in self._queue.awaited():
            field = self._records.get_field(reference)
            if field is None or field.state != "validating":
                self._queue.release(reference)

    def _look_after_job(self, job: JobRecord, now: float) -> str | None:
        """Mend one active job; the action's name, None when nothing was amiss. Raises StaleAttemptError."""
        if job.status == "accepted":
            if self._queue.holds_registration(job.id, job.attempt) or not self._is_unheld(job.id, job.attempt):
                return None
            self._queue.enqueue_registration(job.id, job.attempt, job.owner, job.is_of_batch)
            return "enqueued"
        if not self._is_lost(job, now):
            return None
        if job.cancel_requested:
            self._records.update_job(job.id, job.attempt, status="dismissed")
            return "dismissed"
        if job.requeues == 0:
            again = self._records.requeue_job(job.id, job.attempt)
            self._queue.enqueue_registration(again.id, again.attempt, again.owner, again.is_of_batch)
            return "requeued"
        self._records.update_job(job.id, job.attempt, status="failed", error=problem_document("WORKER_LOST"))
        return "failed"

    def _is_unheld(self, name: str, attempt: int) -> bool:
        """Whether work has been in no queue for a while; before that, another process may be adding it."""
        return self._staleness.of(f"{name}:unheld", attempt) >= _UNHELD_FOR_S

    def _is_lost(self, job: JobRecord, now: float) -> bool:
        """Whether the worker is gone: the heartbeat is old, and was seen unchanged for long enough.

        Its age alone proves nothing: Redis' clock may be stepped, and no worker can write while Redis is away.
        """
        beaten = job.heartbeat or job.updated
        still = self._staleness.of(job.id, (job.attempt, beaten))
        silent = now - beaten >= self._lost_after_s
        return still >= self._lost_after_s or (silent and still >= self._lost_after_s / 6)

    def _look_after_import(self, field: FieldRecord, _now: float) -> str | None:
        sha256, attempt = field.sha256, field.attempt
        if self._queue.holds_import(sha256, attempt) or not self._is_unheld(sha256, attempt):
            return None
        if field.requeues < _IMPORT_RETRIES:
            again = self._records.retry_import(field.sha256, field.attempt)
            self._queue.enqueue_import(again.sha256, again.attempt)
            return "requeued"
        self._records.update_field(
            field.sha256, attempt=field.attempt, state="rejected", error=problem_document("WORKER_LOST")
        )
        if self._blobs is not None:
            self._blobs.delete_prefix(f"fields/{field.sha256}")
        return "failed"


def _note(done: Done, name: str, look: Callable[[_Record, float], str | None], record: _Record, now: float) -> None:
    try:
        action = look(record, now)
    except StaleAttemptError:
        return  # it has changed in between
    except (RedisError, OSError, LeaseLostError):
        raise
    except Exception:
        logger.exception("%s is skipped in this round: an internal error", name)
        return
    if action is not None:
        done[action].append(name)
        logger.warning("%s: %s", name, action)

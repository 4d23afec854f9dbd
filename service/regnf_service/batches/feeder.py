"""Hands the pairs of batches to the queue, a few at a time, and writes down how they end.

Each round looks at the batches of every caller. A caller has no more of its batches' jobs in the queue than its workers
do in two rounds: the rest waits in the storage, where it delays nobody. What is wrong with a pair becomes its result.
A limit that holds the caller back (a quota, a full queue) holds its batches back until it is over.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from redis.exceptions import RedisError

from regnf_service.batches.cancelling import stop_jobs
from regnf_service.batches.outcome import counted_as, outcome
from regnf_service.jobs.submit import check_fields, future_job_id, submit
from regnf_service.problem import Problem
from regnf_service.services import Services
from regnf_service.upkeep.lease import Lease
from regnf_state.batch_records import BatchName, BatchState, OpenPair, Pair
from regnf_state.batches import StaleBatchError
from regnf_state.records import ACTIVE, JobRecord, UnreadableRecordError
from regnf_state.redis.keys import PREFIX
from regnf_state.registration_request import RegistrationRequest

_LEADER_KEY = f"{PREFIX}batches:feeder"
_LEADS_FOR_S = 10.0
_LOOKED_AT = 200
"""Pairs of a batch that a round looks at, most of them lines that are no requests."""
_WRITE_AFTER_S = 1.0
_WRITE_AT_ONCE = 64
"""Results wait for others of their block so long at most, or until there are so many."""
_TRIES = 4
"""How often a pair's job is started that its workers did not survive."""
_WAITS = frozenset({429, 503, 507})
"""Statuses of refusals that time mends."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Requests:
    """What POST /register makes of a line, and of what goes wrong with it.

    read: a line's members as the job's request, with the fields that the caller must have, by where they are named.
    """

    read: Callable[[Services, str, dict[str, Any]], tuple[RegistrationRequest, dict[str, str]]]
    problem_of: Callable[[Exception], Problem]


@dataclass
class _Round:
    """One batch in one round. jobs: those of its open pairs, by their ids · ahead: the pairs to look at."""

    name: BatchName
    state: BatchState
    jobs: dict[str, JobRecord | None]
    ahead: Iterator[Pair]
    waits_for: str | None = None
    looked_at: int = 0
    is_at_end: bool = False
    added: list[OpenPair] = field(default_factory=list)

    @property
    def open(self) -> list[OpenPair]:
        return [*self.state.open, *self.added]

    def runs(self, one: OpenPair) -> bool:
        """Whether its job waits or runs."""
        job = self.jobs.get(one.job)
        return one.error is None and bool(one.job) and job is not None and job.status in ACTIVE

    def is_to_repeat(self, one: OpenPair) -> bool:
        """Whether its job has ended in a way that says nothing of the pair."""
        job = self.jobs.get(one.job)
        if job is None or one.tries >= _TRIES:
            return False
        lost = job.status == "failed" and (job.error or {}).get("reason") == "WORKER_LOST"
        return lost or (one.stopped and job.status == "dismissed")

    @property
    def running(self) -> int:
        return sum(map(self.runs, self.open))


class Feeder:
    """Call ``run_once`` every half a second, from as many processes as like: one at a time does the work."""

    def __init__(self, services: Services, requests: Requests) -> None:
        self._services = services
        self._requests = requests
        self._batches = services.batches
        self._lease = Lease(services.redis, _LEADER_KEY, _LEADS_FOR_S)
        self._pace: Counter[str] = Counter()

    def run_once(self) -> bool:
        """One round; whether a batch goes on. Raises RedisError, OSError."""
        self._batches.rebuild_if_needed()
        by_owner: dict[str, list[BatchName]] = defaultdict(list)
        for name in self._batches.index.open():
            by_owner[name.owner].append(name)
        if not by_owner:
            return False
        with self._lease.held() as term:
            for owner, names in by_owner.items() if term is not None else ():
                self._of_caller(owner, names)
        return True

    def expire(self) -> list[str]:
        """Batches that have outlived their retention go: their ids."""
        return self._batches.expire(self._services.records.now())

    def _of_caller(self, owner: str, names: Sequence[BatchName]) -> None:
        rounds = [one for name in names if (one := self._begin(name)) is not None]
        ended = sum(not one.runs(pair) for one in rounds for pair in one.state.open)
        room = self._window(owner, ended) - sum(one.running for one in rounds)
        self._hand_out(rounds, room)
        for one in rounds:
            try:
                self._finish(one)
            except StaleBatchError:
                self._undo(one)

    def _window(self, owner: str, ended: int) -> int:
        """How many jobs a caller's batches may have in the queue: as many as end in two rounds, and one for each worker
        that waits."""
        self._pace[owner] = max(ended, self._pace[owner] // 2)
        return 2 * max(1, self._services.queue.live_workers(), self._pace[owner])

    def _begin(self, name: BatchName) -> _Round | None:
        try:
            state = self._batches.state(name)
        except (FileNotFoundError, UnreadableRecordError) as error:
            logger.error("batch %s is left: %s", name.id, error)
            self._batches.index.drop(name, None)
            return None
        if state.status != "running":
            self._batches.index.note(name, state)
            return None
        ids = [one.job for one in state.open if one.job]
        jobs = dict(zip(ids, self._services.records.get_jobs(ids), strict=True))
        return _Round(name, state, jobs, self._batches.pairs(name, state.next, state.offset))

    # handing out

    def _hand_out(self, rounds: Sequence[_Round], room: int) -> None:
        """Give each batch in turn one of the places that are left."""
        self._start_lost(rounds)
        waiting = list(rounds)
        while waiting and room > 0:
            for one in list(waiting):
                before = one.running
                if room <= 0 or one.waits_for or not self._look_at_next(one):
                    waiting.remove(one)
                room -= one.running - before

    def _look_at_next(self, one: _Round) -> bool:
        """Look at a batch's next pair; False when there is none now."""
        if one.looked_at >= _LOOKED_AT:
            return False
        state = one.state
        pair = next(one.ahead, None)
        if pair is None:
            one.is_at_end = True
            return False
        one.looked_at += 1
        if state.wants(pair.number) and (opened := self._open(one, pair)) is not None:
            one.added.append(opened)
        if one.waits_for is None:
            one.state = replace(state, next=pair.number + 1, offset=pair.end)
        return one.waits_for is None

    def _open(self, one: _Round, pair: Pair) -> OpenPair | None:
        """The pair with its job; with an error where it can have none; None where it has to wait."""
        if pair.error is not None:
            return OpenPair(pair.number, pair.offset, error=pair.error)
        try:
            job, started = self._job_of(one, pair)
        except (RedisError, OSError) as error:
            if self._requests.problem_of(error).status not in _WAITS:
                raise
            one.waits_for = self._requests.problem_of(error).reason
            return None
        except Exception as error:
            problem = self._requests.problem_of(error)
            if problem.status in _WAITS:
                one.waits_for = problem.reason
                return None
            if problem.reason == "INTERNAL":
                logger.exception("batch %s: pair %d", one.name.id, pair.number)
            return OpenPair(pair.number, pair.offset, error=problem.document())
        one.jobs[job.id] = job
        return OpenPair(pair.number, pair.offset, job.id, started)

    def _job_of(self, one: _Round, pair: Pair) -> tuple[JobRecord, bool]:
        """The job of a pair, and whether it was started now. What has ended since the pass began is not repeated."""
        services, owner = self._services, one.name.owner
        asked, named = self._requests.read(self._services, one.name.owner, pair.request or {})
        check_fields(services, owner, asked, named)
        known = services.records.get_job(future_job_id(services, owner, asked))
        if known is not None and asked.webhook is None:
            since_then = known.finished is not None and known.finished >= one.state.since
            if known.status in (*ACTIVE, "successful") or since_then:
                return known, False
        return submit(services, owner, asked, None), True

    def _start_lost(self, rounds: Sequence[_Round]) -> None:
        """Start jobs anew that two workers in turn did not survive, or that were stopped before the batch went on."""
        for one in rounds:
            kept = [self._again(one, each) if one.is_to_repeat(each) else each for each in one.state.open]
            one.state = replace(one.state, open=kept)

    def _again(self, one: _Round, lost: OpenPair) -> OpenPair:
        pair = next(self._batches.pairs(one.name, lost.number, lost.offset))
        asked, _ = self._requests.read(self._services, one.name.owner, pair.request or {})
        try:
            job = submit(self._services, one.name.owner, asked, None)
        except (RedisError, OSError):
            raise
        except Exception as error:  # noqa: BLE001 -- it ends as it did
            logger.warning("batch %s: pair %d is not started again: %s", one.name.id, pair.number, error)
            return lost
        one.jobs[job.id] = job
        return replace(lost, tries=lost.tries + 1, started=True, stopped=False)

    # writing down

    def _finish(self, one: _Round) -> None:
        """Keep where the batch is; with its next block, where enough has ended. Raises StaleBatchError."""
        before = self._batches.index.state(one.name)
        state = replace(one.state, open=one.open, waits_for=one.waits_for)
        ended = [pair for pair in state.open if not one.runs(pair)]
        now = self._services.records.now()
        is_last = one.is_at_end and len(ended) == len(state.open)
        if is_last or len(ended) >= _WRITE_AT_ONCE or (ended and now - state.updated >= _WRITE_AFTER_S):
            self._write(one, state, ended, now, is_last)
        elif state != before and not self._batches.index.note(one.name, state):
            raise StaleBatchError(one.name.id)

    def _write(self, one: _Round, state: BatchState, ended: list[OpenPair], now: float, is_last: bool) -> None:
        lines = [self._line(one, pair) for pair in ended]
        counts = Counter(state.counts) + Counter(map(counted_as, lines))
        after = replace(state, open=[pair for pair in state.open if one.runs(pair)], counts=dict(counts), updated=now)
        if is_last:
            after = replace(after, status="finished", finished=now, waits_for=None)
        self._batches.write(one.name, after, lines)

    def _line(self, one: _Round, ended: OpenPair) -> dict[str, Any]:
        pair = next(self._batches.pairs(one.name, ended.number, ended.offset))
        return outcome(self._services, pair, ended, one.jobs.get(ended.job))

    def _undo(self, one: _Round) -> None:
        """The batch was changed by another process: what was handed out here is stopped if it was cancelled."""
        try:
            if self._batches.state(one.name).status == "dismissed":
                stop_jobs(self._services, one.name, one.added)
        except FileNotFoundError:
            stop_jobs(self._services, one.name, one.added)

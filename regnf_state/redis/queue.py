"""The queue to the workers: ids only, results and failures kept nowhere but in the records."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Sequence
from typing import Any, NamedTuple

from redis import Redis
from redis.exceptions import ResponseError

from regnf_state.ownership import ANONYMOUS, owner_of
from regnf_state.queue import Kind, Work
from regnf_state.records import JobRecord
from regnf_state.redis.documents import shown
from regnf_state.redis.fair_queue import LISTS, RUNNING, FairQueue, Waiting, entry_key
from regnf_state.redis.unreadable import PREFIX

_WORKERS = f"{PREFIX}workers"
"""Sorted set: every worker's name by the time of its last report."""
_LIVE_FOR_S = 45
_HELD_FOR_S = 60
"""What a worker has taken, and has said nothing of for so long, is not being run any more."""
_STOP = b"stop"


class ForeignWorkError(ValueError):
    """What lies in the queue is not of this service. Says what is wrong with it, and repeats nothing of it."""


class Taken(NamedTuple):
    """A name that has left the list of its kind."""

    kind: Kind
    name: str


class JobQueue(FairQueue):
    """Hands ids to workers, each at most once per attempt: enqueueing what is known already changes nothing.

    ``key`` signs what is put into Redis. A worker believes nothing of it but a name, and with a key only one that the
    service has signed.
    """

    def __init__(self, redis: Redis, key: str | None = None) -> None:
        super().__init__(redis)
        self._key = key

    def enqueue_registration(self, job_id: str, attempt: int, owner: str = ANONYMOUS, of_batch: bool = False) -> None:
        """of_batch: it waits behind all that its owner has posted by itself, so that a batch holds nothing up."""
        self.enqueue(self._waiting(Work("registration", job_id, attempt), owner, of_batch))

    def enqueue_jobs(self, jobs: Sequence[JobRecord]) -> None:
        """The same for several accepted jobs, in one round trip, in their order."""
        self.enqueue(
            *(self._waiting(Work("registration", job.id, job.attempt), job.owner, job.is_of_batch) for job in jobs)
        )

    def enqueue_import(self, sha256: str, attempt: int = 1) -> None:
        """Its owner is named in the field's reference."""
        self.enqueue(self._waiting(Work("import", sha256, attempt), owner_of(sha256)))

    def _waiting(self, work: Work, owner: str, of_batch: bool = False) -> Waiting:
        return Waiting(work, owner, of_batch, self._signature(work))

    def _signature(self, work: Work) -> str:
        """HMAC-SHA256 over the kind and the name, which holds the argument and the attempt; without a key, nothing."""
        said = f"regnf-queue-2\n{work.kind}\n{work.name}".encode()
        return hmac.new(self._key.encode(), said, hashlib.sha256).hexdigest() if self._key is not None else ""

    def holds_registration(self, job_id: str, attempt: int) -> bool:
        """Whether the queue still knows of this attempt, waiting or running."""
        return self.holds(Work("registration", job_id, attempt).name)

    def holds_import(self, sha256: str, attempt: int) -> bool:
        return self.holds(Work("import", sha256, attempt).name)

    def stop(self, job_id: str, attempt: int) -> None:
        """Take a waiting job out of the queue, or tell the worker to end a running one."""
        name = Work("registration", job_id, attempt).name
        if not self.remove(name):
            self._redis.set(f"{RUNNING}{name}", _STOP, xx=True, ex=_HELD_FOR_S)

    def drop_import(self, sha256: str, attempt: int) -> None:
        """Take a waiting import out of the queue: its field is gone. One that runs goes on, and finds that itself."""
        self.remove(Work("import", sha256, attempt).name)

    # for workers

    def pop(self, seconds: int) -> Taken | None:
        """The next name, waited for so many seconds (0: not at all); None when there is none."""
        self.turn()
        found: Any
        if seconds:
            found = self._redis.blpop(list(LISTS.values()), seconds)
        else:
            found = next(((key, name) for key in LISTS.values() if (name := self._redis.lpop(key)) is not None), None)
        if found is None:
            return None
        kinds: dict[str, Kind] = {key: kind for kind, key in LISTS.items()}
        return Taken(kinds[shown(found[0])], shown(found[1]))

    def work_of(self, taken: Taken) -> Work | None:
        """The work that a name means; None for what was stopped meanwhile. Raises ForeignWorkError."""
        try:
            work = Work.named(taken.kind, taken.name)
            held: Any = self._redis.hget(entry_key(work.name), "signature")
        except ValueError as error:
            raise ForeignWorkError(str(error)) from error
        except ResponseError as error:
            if "WRONGTYPE" not in str(error):
                raise
            raise ForeignWorkError("not a hash") from error
        if held is not None and not hmac.compare_digest(held, self._signature(work).encode()):
            raise ForeignWorkError("not signed with the key of this service")
        return None if held is None else work

    def begin(self, name: str, worker: str) -> None:
        """The worker runs it from now on."""
        self._redis.set(f"{RUNNING}{name}", worker, ex=_HELD_FOR_S)

    def goes_on(self, name: str, worker: str) -> bool:
        """Say so again, every few seconds; False once the work shall stop."""
        held: Any = self._redis.getex(f"{RUNNING}{name}", ex=_HELD_FOR_S)
        if held is None:
            self.begin(name, worker)
        return bool(held != _STOP)

    def end(self, name: str) -> None:
        """It has ended. What became of it is in its record."""
        self._redis.delete(f"{RUNNING}{name}", entry_key(name))

    def report(self, worker: str) -> None:
        """The worker lives."""
        seconds, _ = self._redis.time()
        self._redis.zadd(_WORKERS, {worker: seconds})
        self._redis.zremrangebyscore(_WORKERS, "-inf", seconds - _LIVE_FOR_S)

    def sign_off(self, worker: str) -> None:
        self._redis.zrem(_WORKERS, worker)

    def workers(self) -> list[str]:
        """The names of those that have reported lately: `host:id`."""
        seconds, _ = self._redis.time()
        names: Any = self._redis.zrangebyscore(_WORKERS, seconds - _LIVE_FOR_S, "+inf")
        return [shown(name) for name in names]

    def live_workers(self) -> int:
        """How many workers have reported lately."""
        return len(self.workers())

"""A caller who holds a worker leaves the last free one to those who may come back, and for nobody else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
from redis import Redis

from regnf_state.queue import Work
from regnf_state.redis.fair_queue import FairQueue

WORKERS, LIST = "rq:workers:regnf", "rq:queue:regnf"
TAKEN, ASKED = "regnf:queue:taken", "regnf:queue:asked"
WINDOW_S = 300.0


@dataclass
class Floor:
    """A fair queue, and workers that report as RQ has it; time passes where a test says so."""

    redis: Redis
    reserve_s: float = WINDOW_S

    def __post_init__(self) -> None:
        self.fair = FairQueue(self.redis, reserve_s=self.reserve_s)

    def have_workers(self, count: int) -> None:
        for number in range(count):
            self.redis.sadd(WORKERS, f"rq:worker:{number}")
            self.redis.hset(f"rq:worker:{number}", "birth", "now")

    def enqueue(self, owner: str, count: int = 1) -> None:
        for _ in range(count):
            work = Work("registration", f"{owner}-{self.redis.incr('numbers')}", 1)
            assert self.fair.enqueue(work, owner, {"owner": owner})

    def comes_and_goes(self, owner: str) -> None:
        """A caller whose only job has been done."""
        self.enqueue(owner)
        name = self.take()
        assert name is not None
        assert self.owner(name) == owner
        self.end(name)

    def take(self) -> str | None:
        """What a free worker gets; it reports that it runs it."""
        self.fair.turn()
        found: Any = self.redis.lpop(LIST)
        if found is None:
            return None
        name: str = found.decode()
        self.redis.zadd(f"rq:executions:{name}", {"run": 1})
        self.redis.set(f"rq:execution:{name}:run", "reported", ex=61)
        self.fair.turn()
        return name

    def owners(self, count: int) -> list[str | None]:
        """Whose work so many free workers get."""
        return [None if name is None else self.owner(name) for name in [self.take() for _ in range(count)]]

    def owner(self, name: str) -> str:
        held: Any = self.redis.hget(f"rq:job:{name}", "owner")
        return str(held.decode())

    def end(self, name: str, seconds: float = 1.0) -> None:
        self.stop_reporting(name)
        self.fair.finish(name, seconds)

    def stop_reporting(self, name: str) -> None:
        """What a worker's death leads to, once its report has expired."""
        self.redis.delete(f"rq:execution:{name}:run", f"rq:executions:{name}")

    def taken_long_ago(self, name: str) -> None:
        self.redis.hincrbyfloat(f"regnf:queue:entry:{name}", "taken", -60.0)

    def asked_long_ago(self, owner: str) -> None:
        self.redis.zincrby(ASKED, -WINDOW_S - 1.0, owner)


@pytest.fixture
def floor(redis: Redis) -> Floor:
    made = Floor(redis)
    made.have_workers(2)
    return made


def test_a_caller_alone_has_all_workers(floor: Floor) -> None:
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", "greedy"]


def test_one_worker_stays_free_for_a_caller_who_has_been_here(floor: Floor) -> None:
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", None]
    floor.enqueue("honest")
    assert floor.owners(1) == ["honest"]


def test_without_a_reserve_all_workers_are_given_out(redis: Redis) -> None:
    floor = Floor(redis, reserve_s=0.0)
    floor.have_workers(2)
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", "greedy"]


def test_the_reserve_ends_some_time_after_the_last_request(floor: Floor) -> None:
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", None]
    floor.asked_long_ago("honest")
    assert floor.owners(1) == ["greedy"]


def test_a_result_renews_it(floor: Floor) -> None:
    """A caller who gets a result after a long wait is about to ask for more."""
    floor.enqueue("honest")
    name = floor.take()
    assert name is not None
    floor.asked_long_ago("honest")
    floor.end(name)
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", None]


@pytest.mark.parametrize(("workers", "given"), [(0, 2), (1, 2), (2, 1), (3, 2), (5, 4)])
def test_it_is_one_worker_of_those_that_live(redis: Redis, workers: int, given: int) -> None:
    """With one there is none: what lies in the list is for whenever that one is free again."""
    floor = Floor(redis)
    floor.have_workers(workers)
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 9)
    assert floor.owners(given + 1)[:given] == ["greedy"] * given
    assert workers < 2 or floor.take() is None


@pytest.mark.parametrize("dead", ["expired", "signed off"])
def test_dead_workers_do_not_count(redis: Redis, dead: str) -> None:
    floor = Floor(redis)
    floor.have_workers(3)
    if dead == "expired":
        redis.delete("rq:worker:2")
    else:
        redis.hset("rq:worker:2", "death", "now")
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", None]


def test_what_was_passed_over_is_taken_when_the_caller_s_own_work_has_ended(floor: Floor) -> None:
    """However long others may come back: a caller who holds no worker is never held back."""
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 20)
    for _ in range(20):
        name = floor.take()
        assert name is not None
        assert floor.take() is None
        floor.comes_and_goes("honest")
        floor.end(name)
    assert floor.fair.lines() == []


def test_work_that_no_worker_reports_any_more_holds_none(floor: Floor) -> None:
    """kill -9 of a worker: nobody tells the queue, the report expires."""
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    lost = floor.take()
    assert lost is not None
    floor.taken_long_ago(lost)
    assert floor.take() is None
    floor.stop_reporting(lost)
    assert floor.owners(2) == ["greedy", None]
    assert floor.redis.scard(TAKEN) == 1


def test_work_that_was_taken_a_moment_ago_holds_a_worker_before_that_reports(floor: Floor) -> None:
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    assert floor.redis.lpop(LIST) is not None
    floor.fair.turn()
    assert floor.redis.llen(LIST) == 0


def test_the_reserve_is_for_who_holds_none_even_if_it_has_had_as_much(floor: Floor) -> None:
    """By worker seconds it would be the greedy caller's turn; the worker was kept free for the other one."""
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", None]
    floor.redis.zadd("regnf:queue:owners", {"greedy": -100.0})
    floor.redis.hset("regnf:queue:tags", "greedy", "-100")
    floor.enqueue("honest", 2)
    assert floor.owners(2) == ["honest", "greedy"], "who holds a worker each shares the rest by worker seconds"


def test_callers_who_all_have_work_share_all_workers(floor: Floor) -> None:
    """The reserve holds nothing back in all: whoever holds none has its turn."""
    for owner in "abc":
        floor.comes_and_goes(owner)
    for owner in "abc":
        floor.enqueue(owner, 3)
    running = [floor.take(), floor.take()]
    assert None not in running
    for _ in range(6):
        first = running.pop(0)
        assert first is not None
        floor.end(first)
        running.append(floor.take())
        assert running[-1] is not None
    served = [floor.owner(name) for name in running if name is not None]
    assert len(served) == 2


@pytest.mark.parametrize("workers", [2, 3])
def test_a_weight_counts_where_two_callers_have_work_all_the_time(redis: Redis, workers: int) -> None:
    floor = Floor(redis)
    floor.fair = FairQueue(redis, {"heavy": 3.0}, WINDOW_S)
    floor.have_workers(workers)
    floor.enqueue("heavy", 90)
    floor.enqueue("light", 90)
    running = [floor.take() for _ in range(workers)]
    served = []
    for _ in range(60):
        first = running.pop(0)
        assert first is not None
        served.append(floor.owner(first))
        floor.end(first, 10.0)
        running.append(floor.take())
    assert abs(served.count("heavy") - 45) <= 5


def test_a_clock_that_was_set_back_reserves_nothing_for_long(floor: Floor) -> None:
    floor.comes_and_goes("honest")
    floor.enqueue("greedy", 5)
    held = floor.take()
    assert held is not None
    floor.stop_reporting(held)
    floor.redis.hincrbyfloat(f"regnf:queue:entry:{held}", "taken", 3600.0)
    floor.redis.zincrby(ASKED, 3600.0, "honest")
    assert floor.owners(2) == ["greedy", "greedy"]


@pytest.mark.parametrize("kind", ["string", "list"])
def test_workers_entries_of_another_type_reserve_nothing(floor: Floor, kind: str) -> None:
    floor.comes_and_goes("honest")
    for key in (WORKERS, "rq:worker:0"):
        floor.redis.delete(key)
        _ = floor.redis.set(key, "x") if kind == "string" else floor.redis.rpush(key, "x")
    floor.enqueue("greedy", 5)
    assert floor.owners(2) == ["greedy", "greedy"]
